// SPDX-License-Identifier: MIT OR Apache-2.0
//! Commands that are printed before they run, timed, and counted at the end.

use crate::machine;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, ExitCode, ExitStatus};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// How a step ended.
#[derive(Serialize, Deserialize)]
pub enum Outcome {
    Ok,
    Failed(String),
    Skipped(String),
}

impl Outcome {
    /// Of what runs with something that not every machine can have: where CI is not set, it is skipped without.
    pub fn with<T, O: Into<Outcome>>(needed: Result<T, String>, run: impl FnOnce(T) -> O) -> Outcome {
        match needed {
            Ok(needed) => run(needed).into(),
            Err(reason) => Outcome::Failed(reason).unless_ci(),
        }
    }

    /// Of what needs a network or a program that not every machine has: where CI is not set, that it failed is a reason to go without.
    pub fn unless_ci(self) -> Outcome {
        match self {
            Outcome::Failed(reason) if !machine::is_ci() => Outcome::Skipped(reason),
            other => other,
        }
    }
}

impl From<Result<(), String>> for Outcome {
    fn from(result: Result<(), String>) -> Outcome {
        result.map_or_else(Outcome::Failed, |()| Outcome::Ok)
    }
}

/// A step that has ended.
#[derive(Serialize, Deserialize)]
pub struct Done {
    pub name: String,
    pub outcome: Outcome,
    took: Duration,
    /// How many cores its processes used, on average: one that waits can run beside another.
    cores: f64,
}

/// The steps of a task. One that fails does not stop those after it.
pub struct Steps {
    start: Instant,
    pub done: Vec<Done>,
}

impl Steps {
    pub fn new() -> Self {
        Steps { start: Instant::now(), done: Vec::new() }
    }

    /// Runs a command as a step; says whether it succeeded.
    pub fn command(&mut self, name: &str, command: &mut Command) -> bool {
        self.step(name, || execute(command))
    }

    /// Runs a function as a step; says whether it succeeded. What one makes that is not chosen is taken as it is.
    pub fn step<T: Into<Outcome>>(&mut self, name: &str, run: impl FnOnce() -> T) -> bool {
        if !is_chosen(name, only()) {
            return true;
        }
        let (start, used) = (Instant::now(), machine::used_by_children());
        let outcome = run().into();
        let took = start.elapsed();
        let cores = (machine::used_by_children() - used) / took.as_secs_f64().max(0.01);
        let succeeded = matches!(outcome, Outcome::Ok);
        println!("{name}: {}, {:.1} s", text(&outcome), took.as_secs_f64());
        self.done.push(Done { name: name.to_owned(), outcome, took, cores });
        succeeded
    }

    /// Whether every step so far was run and succeeded.
    pub fn are_all_ok(&self) -> bool {
        self.done.iter().all(|done| matches!(done.outcome, Outcome::Ok))
    }

    /// Notes a step that is not run, and why.
    pub fn skip(&mut self, name: &str, reason: &str) {
        self.step(name, || Outcome::Skipped(reason.to_owned()));
    }

    /// Notes what failed without being a step.
    pub fn fail(&mut self, name: &str, reason: String) {
        let outcome = Outcome::Failed(reason);
        self.done.push(Done { name: name.to_owned(), outcome, took: Duration::ZERO, cores: 0.0 });
    }

    /// Prints the table and, as the last line, the counts.
    pub fn finish(mut self) -> ExitCode {
        for begin in only() {
            if !self.done.iter().any(|done| done.name.starts_with(begin)) {
                let reason = "no step's name begins so: a run without --only prints them all";
                self.fail(begin, reason.to_owned());
            }
        }
        let width = self.done.iter().map(|done| done.name.len()).max().unwrap_or(0);
        println!("\n{:<width$}  seconds  cores", "step");
        for Done { name, outcome, took, cores } in &self.done {
            println!("{name:<width$}  {:7.1}  {cores:5.1}  {}", took.as_secs_f64(), text(outcome));
        }
        println!("{:<width$}  {:7.1}\n", "all", self.start.elapsed().as_secs_f64());
        let count = |kind: fn(&Outcome) -> bool| self.done.iter().filter(|done| kind(&done.outcome)).count();
        let failed = count(|outcome| matches!(outcome, Outcome::Failed(_)));
        let passed = count(|outcome| matches!(outcome, Outcome::Ok));
        let skipped = count(|outcome| matches!(outcome, Outcome::Skipped(_)));
        println!("{passed} passed, {failed} failed, {skipped} skipped");
        ExitCode::from(u8::from(failed != 0))
    }
}

pub fn text(outcome: &Outcome) -> String {
    match outcome {
        Outcome::Ok => "ok".to_owned(),
        Outcome::Failed(reason) => format!("FAILED: {reason}"),
        Outcome::Skipped(reason) => format!("skipped: {reason}"),
    }
}

/// Variables that all builds have.
static VARIABLES: OnceLock<Vec<(&'static str, String)>> = OnceLock::new();

/// From now on builds have these variables. What one of them is changed for is built anew, with all that needs it: so builds that have
/// some in common should all have them.
pub fn build_with(variables: Vec<(&'static str, String)>) {
    // The first ones stay.
    let _ = VARIABLES.set(variables);
}

/// Those that [`build_with`] was given, for what is no command of cargo's.
pub fn variables() -> impl Iterator<Item = (&'static str, String)> {
    VARIABLES.get().into_iter().flatten().cloned()
}

/// Beginnings of the names of what is run, if not all is.
static ONLY: OnceLock<Vec<String>> = OnceLock::new();

/// From now on these steps alone are run; all if there is none.
pub fn run_only(beginnings: Vec<String>) {
    // The first ones stay.
    let _ = ONLY.set(beginnings);
}

pub fn only() -> &'static [String] {
    ONLY.get().map_or(&[], Vec::as_slice)
}

fn is_chosen(name: &str, beginnings: &[String]) -> bool {
    // What all others need.
    const FIRST: [&str; 2] = ["ros", "libclang"];
    beginnings.is_empty() || FIRST.contains(&name) || beginnings.iter().any(|begin| name.starts_with(begin))
}

/// Whether cargo writes down where the time of a build goes.
static TIMINGS: OnceLock<()> = OnceLock::new();

/// If it is asked for, builds leave a report each from now on, under `cargo-timings` in the target directory.
pub fn keep_timings(asked: bool) {
    if asked {
        // The first one stays.
        let _ = TIMINGS.set(());
    }
}

pub fn are_timings_kept() -> bool {
    TIMINGS.get().is_some()
}

/// `cargo` with these arguments, which contain no spaces.
pub fn cargo(arguments: &str) -> Command {
    cargo_with(arguments, [])
}

/// [`cargo`] with more arguments of cargo's own.
pub fn cargo_with(arguments: &str, more: impl IntoIterator<Item = String>) -> Command {
    let mut command = Command::new("cargo");
    let mut words = arguments.split(' ');
    command.args(words.by_ref().take_while(|word| *word != "--"));
    let is_build =
        ["build ", "clippy ", "test ", "nextest run "].iter().any(|verb| arguments.starts_with(verb));
    command.args((is_build && are_timings_kept()).then_some("--timings")).args(more);
    if arguments.split(' ').any(|word| word == "--") {
        command.arg("--").args(words);
    }
    command.envs(variables());
    command
}

/// What a command prints, or what it says of its failure.
pub fn stdout_of(command: &mut Command) -> Result<String, String> {
    let output = command.output().map_err(|error| format!("{}: {error}", command.get_program().display()))?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    Err(String::from_utf8_lossy(&output.stderr).trim().to_owned())
}

/// The JSON that a command prints.
pub fn json_of(command: &mut Command) -> Result<Value, String> {
    let program = command.get_program().display().to_string();
    serde_json::from_str(&stdout_of(command)?).map_err(|error| format!("{program}: {error}"))
}

/// Prints a command and runs it.
pub fn execute(command: &mut Command) -> Result<(), String> {
    announce(command);
    ended(command.status())
}

/// Runs what writes a report to this file, and checks the report if it ends well.
pub fn reported(
    command: &mut Command,
    report: &Path,
    check: impl FnOnce() -> Result<(), String>,
) -> Result<(), String> {
    // None of an earlier run.
    let _ = std::fs::remove_file(report);
    execute(command)?;
    check()
}

/// How a command ended.
pub fn ended(status: std::io::Result<ExitStatus>) -> Result<(), String> {
    match status {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(status.to_string()),
        Err(error) => Err(format!("cannot be started: {error}")),
    }
}

/// Prints a command so that it can be pasted into a shell.
pub fn announce(command: &Command) {
    let mut line = String::from("\n$");
    for (name, value) in command.get_envs() {
        let value = value.unwrap_or_default().to_string_lossy();
        line += &format!(" {}={}", name.to_string_lossy(), quoted(&value));
    }
    for word in std::iter::once(command.get_program()).chain(command.get_args()) {
        line += &format!(" {}", quoted(&word.to_string_lossy()));
    }
    println!("{line}");
}

fn quoted(word: &str) -> String {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "_./:=,@%+-".contains(letter);
    if word.chars().all(is_plain) { word.to_owned() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_chosen_by_how_their_names_begin() {
        let only = ["bench: do".to_owned(), "fuzz".to_owned()];
        let chosen =
            ["ros", "build", "bench: domain", "bench: wake", "fuzz: yaml"].map(|name| is_chosen(name, &only));
        assert_eq!(chosen, [true, false, true, false, true]);
        assert!(is_chosen("build", &[]));
    }

    #[test]
    fn what_is_printed_can_be_pasted() {
        assert_eq!(quoted("--only=a,b"), "--only=a,b");
        assert_eq!(quoted("lto='off'"), r#"'lto='\''off'\'''"#);
    }

    #[test]
    fn a_failing_step_does_not_stop_the_next() {
        let mut steps = Steps::new();
        assert!(!steps.command("false", &mut Command::new("false")));
        assert!(steps.command("true", &mut Command::new("true")));
        steps.skip("miri", "no nightly");
        assert_eq!(steps.done.len(), 3);
        assert_eq!(steps.finish(), ExitCode::from(1));
    }
}
