// SPDX-License-Identifier: MIT OR Apache-2.0
//! Runs each example and compares what it prints on standard output with `examples/expected/<name>.txt`.

use crate::build::Build;
use crate::running::Running;
use crate::steps::{Outcome, Steps};
use crate::{files, machine};
use std::path::PathBuf;
use std::process::{Command, ExitStatus};
use std::time::{Duration, Instant};

/// Programs with their arguments. Those of one run are started one after the other, each when the one before has printed
/// its first line.
pub const RUNS: [&[&str]; 18] = [
    &["listener 5", "talker 5"],
    &["zero_copy_image"],
    &["variable_image"],
    &["untyped"],
    &["service"],
    &["action"],
    &["timer"],
    &["qos_events"],
    &["lifecycle"],
    &["composition"],
    &["parameters"],
    &["sim_time"],
    &["logging"],
    &["priorities"],
    &["callback_group"],
    &["budget"],
    &["busy_poll"],
    &["own_messages"],
];

/// Have no promise to keep without real-time priorities.
const REALTIME_ONLY: [&str; 2] = ["priorities", "budget"];

/// As in `examples/src/lib.rs`: the example cannot run here.
const SKIPPED: i32 = 77;

/// Far longer than any of them takes.
const PATIENCE: Duration = Duration::from_secs(60);

/// Runs each example, if they were `built`, as a step; with `bless` writes down what it prints.
pub fn run(steps: &mut Steps, built: bool, build: Build, bless: bool) {
    for programs in RUNS {
        let name = programs.iter().map(|program| name_of(program)).collect::<Vec<_>>().join(" + ");
        let name = format!("example {name}");
        if !built {
            steps.skip(&name, "not built");
        } else if programs.iter().any(|program| REALTIME_ONLY.contains(program))
            && std::env::var("TAUT_REALTIME").is_ok_and(|value| value == "off")
        {
            steps.skip(&name, "TAUT_REALTIME=off");
        } else {
            steps.step(&name, || run_together(programs, build, bless));
        }
    }
}

pub fn name_of(program: &str) -> &str {
    program.split(' ').next().unwrap_or(program)
}

fn run_together(programs: &[&str], build: Build, bless: bool) -> Outcome {
    let end = Instant::now() + PATIENCE;
    let mut all = Vec::new();
    for program in programs {
        match Running::start(&mut command(program, build), false) {
            Ok(mut running) => {
                running.wait_until(end, |said| said.contains('\n'));
                all.push((name_of(program), running));
            }
            Err(reason) => return Outcome::Failed(format!("{program}: {reason}")),
        }
    }
    let mut outcome = Outcome::Ok;
    for (name, mut running) in all {
        let status = running.wait_until(end, |_| false);
        print!("{}", running.said());
        match judge(name, status, &running.said(), bless) {
            Outcome::Ok => {}
            other => outcome = other,
        }
    }
    outcome
}

/// An example, or the program of an example that is a crate.
fn command(program: &str, build: Build) -> Command {
    let [example, own] =
        [build.folder().join("examples"), build.folder()].map(|to| to.join(name_of(program)));
    let mut command = Command::new(if example.exists() { example } else { own });
    command.args(program.split(' ').skip(1));
    command
}

fn judge(name: &str, status: Option<ExitStatus>, printed: &str, bless: bool) -> Outcome {
    match status {
        None => Outcome::Failed(format!("{name} did not end within {} s", PATIENCE.as_secs())),
        Some(status) if status.code() == Some(SKIPPED) && !machine::is_ci() => {
            Outcome::Skipped(format!("{name} cannot run here; it says why above"))
        }
        Some(status) if !status.success() => Outcome::Failed(format!("{name}: {status}")),
        Some(_) => compare(name, printed, bless).into(),
    }
}

fn compare(name: &str, printed: &str, bless: bool) -> Result<(), String> {
    let path = expected(name);
    if bless {
        return files::write(&path, printed);
    }
    let expected = files::read(&path).map_err(|reason| format!("{reason}; write it with --bless"))?;
    if expected == printed {
        return Ok(());
    }
    println!("{name} was expected to print:\n{expected}");
    Err(format!("{name} printed other lines than {}", path.display()))
}

/// What it prints.
pub fn expected(name: &str) -> PathBuf {
    machine::root().join("examples/expected").join(name).with_extension("txt")
}
