// SPDX-License-Identifier: MIT OR Apache-2.0
//! Runs each example and compares what it prints on standard output with `examples/expected/<name>.txt`.

use crate::build::Build;
use crate::machine;
use crate::steps::{Outcome, Steps, announce};
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// Programs with their arguments. Those of one run are started one after the other, each when the one before has printed
/// its first line.
const RUNS: [&[&str]; 18] = [
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

/// Has no promise to keep without real-time priorities.
const REALTIME_ONLY: &str = "priorities";

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
        } else if programs.contains(&REALTIME_ONLY)
            && std::env::var("TAUT_REALTIME").is_ok_and(|value| value == "off")
        {
            steps.skip(&name, "TAUT_REALTIME=off");
        } else {
            steps.step(&name, || run_together(programs, build, bless));
        }
    }
}

fn name_of(program: &str) -> &str {
    program.split(' ').next().unwrap_or(program)
}

fn run_together(programs: &[&str], build: Build, bless: bool) -> Outcome {
    let deadline = Instant::now() + PATIENCE;
    let mut running = Vec::new();
    for program in programs {
        match Running::start(program, build) {
            Ok(mut started) => {
                started.await_first_line();
                running.push(started);
            }
            Err(error) => return Outcome::Failed(format!("{program}: {error}")),
        }
    }
    let mut outcome = Outcome::Ok;
    for program in running {
        match program.end(deadline, bless) {
            Outcome::Ok => {}
            other => outcome = other,
        }
    }
    outcome
}

/// A running example; dropping it ends it.
struct Running {
    name: String,
    child: Child,
    lines: Receiver<String>,
    printed: String,
}

impl Running {
    fn start(program: &str, build: Build) -> std::io::Result<Running> {
        let name = name_of(program);
        // An example, or the program of an example that is a crate.
        let folders = [build.folder().join("examples"), build.folder()];
        let [example, program_path] = folders.map(|folder| folder.join(name));
        let mut command = Command::new(if example.exists() { example } else { program_path });
        command.args(program.split(' ').skip(1));
        announce(&command);
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?;
        let (sender, lines) = channel();
        if let Some(output) = child.stdout.take() {
            std::thread::spawn(move || {
                BufReader::new(output).lines().map_while(Result::ok).try_for_each(|line| sender.send(line))
            });
        }
        Ok(Running { name: name.to_owned(), child, lines, printed: String::new() })
    }

    fn await_first_line(&mut self) {
        if let Ok(line) = self.lines.recv_timeout(PATIENCE) {
            self.note(&line);
        }
    }

    fn note(&mut self, line: &str) {
        println!("{line}");
        self.printed += line;
        self.printed.push('\n');
    }

    fn end(mut self, deadline: Instant, bless: bool) -> Outcome {
        let name = self.name.clone();
        // Ends when the program closes its output, or takes too long.
        while let Ok(line) = self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            self.note(&line);
        }
        if Instant::now() >= deadline {
            return Outcome::Failed(format!("{name} did not end within {} s", PATIENCE.as_secs()));
        }
        match self.child.wait() {
            Ok(status) if status.code() == Some(SKIPPED) && !machine::is_ci() => {
                Outcome::Skipped(format!("{name} cannot run here; it says why above"))
            }
            Ok(status) if !status.success() => Outcome::Failed(format!("{name}: {status}")),
            Ok(_) => self.compare(bless),
            Err(error) => Outcome::Failed(format!("{name}: {error}")),
        }
    }

    fn compare(&self, bless: bool) -> Outcome {
        let path = expected(&self.name);
        if bless {
            return match fs::write(&path, &self.printed) {
                Ok(()) => Outcome::Ok,
                Err(error) => Outcome::Failed(format!("{}: {error}", path.display())),
            };
        }
        match fs::read_to_string(&path) {
            Ok(expected) if expected == self.printed => Outcome::Ok,
            Ok(expected) => {
                println!("{} was expected to print:\n{expected}", self.name);
                Outcome::Failed(format!("{} printed other lines than {}", self.name, path.display()))
            }
            Err(error) => Outcome::Failed(format!("{}: {error}; write it with --bless", path.display())),
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn expected(name: &str) -> PathBuf {
    machine::root().join("examples/expected").join(name).with_extension("txt")
}
