// SPDX-License-Identifier: MIT OR Apache-2.0
//! Runs the targets of `fuzz/`: inputs made up by libFuzzer, under the address sanitizer.

use crate::machine;
use crate::steps::{self, Outcome, Steps, announce, cargo, execute};
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Command, ExitCode, Stdio};
use std::time::Instant;

/// What there is to run.
pub const TARGETS: [&str; 10] =
    ["bag", "dynamic", "fill", "json", "owned", "plain", "schema", "view", "wire", "yaml"];

/// Of every run in CI.
pub const RUNS_IN_CI: u64 = 10_000;

const CARGO_FUZZ: &str = "0.13.2";

/// Runs these targets, all if none is named, as steps.
pub fn run(runs: u64, targets: &[String]) -> ExitCode {
    let mut steps = Steps::new();
    let targets: Vec<&str> = match targets {
        [] => TARGETS.to_vec(),
        named => named.iter().map(String::as_str).collect(),
    };
    all(&mut steps, runs, &targets);
    steps.finish()
}

/// As [`run`], among other steps.
pub fn all(steps: &mut Steps, runs: u64, targets: &[&str]) {
    let built = steps.step("fuzz: build", || match cargo_fuzz() {
        Ok(program) => match command(&program, "build") {
            Ok(mut command) => execute(&mut command),
            Err(reason) => Outcome::Failed(reason),
        },
        Err(outcome) => outcome.unless_ci(),
    });
    for target in targets {
        let name = format!("fuzz: {target}");
        if built {
            steps.step(&name, || fuzz(target, runs));
        } else {
            steps.skip(&name, "not built");
        }
    }
}

/// One target, until it fails or has seen so many inputs. What it finds goes to `fuzz/artifacts`, inputs that reach new
/// code to the target directory; it starts from these and from `fuzz/corpus`.
fn fuzz(target: &str, runs: u64) -> Outcome {
    let program = match cargo_fuzz() {
        Ok(program) => program,
        Err(outcome) => return outcome,
    };
    let found = machine::target_dir().join("fuzz/corpus").join(target);
    if let Err(error) = fs::create_dir_all(&found) {
        return Outcome::Failed(format!("cannot create {}: {error}", found.display()));
    }
    let mut command = match command(&program, "run") {
        Ok(command) => command,
        Err(reason) => return Outcome::Failed(reason),
    };
    command.arg(target).arg(found).arg(machine::root().join("fuzz/corpus").join(target));
    command.args(["--", "-timeout=20", "-print_final_stats=1"]).arg(format!("-runs={runs}"));
    announce(&command);
    let start = Instant::now();
    let mut child = match command.stderr(Stdio::piped()).spawn() {
        Ok(child) => child,
        Err(error) => return Outcome::Failed(format!("cannot be started: {error}")),
    };
    let mut executions = None;
    let mut coverage = String::new();
    for line in child.stderr.take().into_iter().flat_map(|stderr| BufReader::new(stderr).lines()) {
        let line = line.unwrap_or_default();
        if let Some(number) = line.strip_prefix("stat::number_of_executed_units:") {
            executions = number.trim().parse::<u64>().ok();
        } else if line.starts_with('#') {
            if let Some((_, covered)) = line.split_once("cov: ") {
                coverage = covered.split(' ').next().unwrap_or_default().to_owned();
            }
            if line.contains("pulse") {
                eprintln!("{line}");
            }
        } else if !line.starts_with("stat::") && !line.trim_start().starts_with("NEW_FUNC") {
            eprintln!("{line}");
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    match (child.wait(), executions) {
        (Ok(status), Some(executions)) if status.success() && executions >= runs => {
            println!(
                "{target}: {executions} executions in {seconds:.1} s, {coverage} places of the code reached"
            );
            Outcome::Ok
        }
        (Ok(status), Some(executions)) => {
            Outcome::Failed(format!("{status} after {executions} of {runs} executions: see fuzz/artifacts"))
        }
        (Ok(status), None) => Outcome::Failed(format!("{status}, with no word of how many executions")),
        (Err(error), _) => Outcome::Failed(error.to_string()),
    }
}

/// cargo-fuzz with one of its verbs. It asks for options that stable compilers have, too, but keep for nightly ones: the compiler is told to take
/// them where it has them, and not cargo, which would build anew what looks at that variable. Macros and build scripts, whose build scripts look for
/// what the compiler can, are then those of the workspace.
fn command(program: &PathBuf, verb: &str) -> Result<Command, String> {
    let rustc = machine::script(
        "rustc-fuzz",
        "case \"$*\" in *-Zsanitizer*) export RUSTC_BOOTSTRAP=1 ;; esac\nexec \"$@\"",
    )?;
    let mut command = Command::new(program);
    command.env("RUSTC_WRAPPER", rustc).envs(steps::variables()).current_dir(machine::root());
    // What the sanitizer says has lines.
    command.env("CARGO_PROFILE_DEV_STRIP", "none");
    // One codegen unit, the default of its release builds, keeps only one core busy.
    command.args([verb, "--dev", "--fuzz-dir", "fuzz", "--codegen-units", "4", "--target-dir"]);
    command.arg(machine::target_dir());
    Ok(command)
}

/// The program, installed under the target directory if it is not there.
fn cargo_fuzz() -> Result<PathBuf, Outcome> {
    let root = machine::target_dir().join("tools");
    let program = root.join("bin/cargo-fuzz");
    let version = Command::new(&program).arg("--version").output();
    if version.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).trim().ends_with(CARGO_FUZZ)) {
        return Ok(program);
    }
    let mut install = cargo("install --debug cargo-fuzz --locked --version");
    match execute(install.arg(CARGO_FUZZ).arg("--root").arg(root)) {
        Outcome::Ok => Ok(program),
        other => Err(other),
    }
}
