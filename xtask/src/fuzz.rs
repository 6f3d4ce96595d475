// SPDX-License-Identifier: MIT OR Apache-2.0
//! Runs the targets of `fuzz/`: inputs made up by libFuzzer, under the address sanitizer.

use crate::build::{Build, SAME};
use crate::steps::{Steps, announce, cargo, execute};
use crate::{files, machine};
use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::Instant;

/// What there is to run.
pub const TARGETS: [&str; 11] =
    ["bag", "dynamic", "fill", "json", "owned", "plain", "schema", "system", "view", "wire", "yaml"];

/// Of every run in CI.
pub const RUNS_IN_CI: u64 = 10_000;

/// What libFuzzer and the address sanitizer ask of the compiler: counters of each edge and what is compared.
const INSTRUMENTED: &str = "--cfg fuzzing -Zsanitizer=address -Cpasses=sancov-module \
    -Cllvm-args=-sanitizer-coverage-level=4 -Cllvm-args=-sanitizer-coverage-inline-8bit-counters \
    -Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares \
    -Cllvm-args=-simplifycfg-branch-fold-threshold=0";

/// Runs these targets, all if none is named, as steps.
pub fn run(steps: &mut Steps, runs: u64, targets: &[String]) {
    let built = steps.step("fuzz: build", || execute(&mut build()?));
    let is_meant = |target: &str| targets.is_empty() || targets.iter().any(|named| named == target);
    for target in TARGETS.into_iter().filter(|target| is_meant(target)) {
        let name = format!("fuzz: {target}");
        if built {
            steps.step(&name, || fuzz(target, runs));
        } else {
            steps.skip(&name, "not built");
        }
    }
}

/// Builds all targets. Tautline's crates are instrumented, the others are those of the tests: libFuzzer looks for new code in ours, and what others
/// allocate has guards, too. The options are unstable: the compiler is told to take them, but not cargo, which would build anew what looks at that
/// variable.
fn build() -> Result<Command, String> {
    // Macros are loaded by the compiler, which has no sanitizer; build scripts are programs of their own.
    let line = format!(
        "case \" $* \" in *\" proc-macro \"*) exec \"$@\" ;; esac\nRUSTC_BOOTSTRAP=1 exec \"$@\" {INSTRUMENTED}"
    );
    let rustc = machine::script("rustc-instrumented", &line)?;
    let mut command =
        cargo(&format!("build -p tautline-fuzz {SAME} --features tautline-fuzz/fuzzing --bins"));
    command.env("RUSTC_WORKSPACE_WRAPPER", rustc);
    // What runs at build time may leave memory to the system when it ends.
    command.env("ASAN_OPTIONS", "detect_leaks=0");
    // Of these, no target runs enough to be worth optimising it.
    for package in ["tautline-doorbell", "tautline-rt", "tautline-trace", "tautline-transport"] {
        command.args(["--config", &format!("profile.dev.package.{package}.opt-level=0")]);
    }
    Ok(command)
}

/// One target, until it fails or has seen so many inputs. What it finds goes to `fuzz/artifacts`, inputs that reach new
/// code to the target directory; it starts from these and from `fuzz/corpus`.
fn fuzz(target: &str, runs: u64) -> Result<(), String> {
    let found = machine::target_dir().join("fuzz/corpus").join(target);
    let artifacts = machine::root().join("fuzz/artifacts").join(target);
    for folder in [&found, &artifacts] {
        fs::create_dir_all(folder).map_err(files::at(folder))?;
    }
    let mut command = Command::new(Build::Tests.folder().join(format!("fuzz-{target}")));
    command.arg(found).arg(machine::root().join("fuzz/corpus").join(target));
    command.args(["-timeout=20", "-print_final_stats=1"]).arg(format!("-runs={runs}"));
    command.arg(format!("-artifact_prefix={}/", artifacts.display()));
    announce(&command);
    let start = Instant::now();
    let child = command.stderr(Stdio::piped()).spawn();
    let mut child = child.map_err(|error| format!("cannot be started: {error}"))?;
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
    let status = child.wait().map_err(|error| error.to_string())?;
    match executions {
        Some(executions) if status.success() && executions >= runs => {
            println!(
                "{target}: {executions} executions in {seconds:.1} s, {coverage} places of the code reached"
            );
            Ok(())
        }
        Some(executions) => {
            Err(format!("{status} after {executions} of {runs} executions: see fuzz/artifacts"))
        }
        None => Err(format!("{status}, with no word of how many executions")),
    }
}
