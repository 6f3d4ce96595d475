// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge to ROS 2: its lints and its tests, against the ROS 2 that is sourced or the one under the target directory.

use crate::build::{Build, TARGETS};
use crate::ros::Distribution;
use crate::steps::{Steps, cargo};
use crate::with_ros::{nextest, programs, with_libraries, with_ros};
use crate::{lab, lints, machine, r2r, ros};
use std::process::Command;

/// Without a ROS 2 it is left out, which is said; but not in CI.
pub fn test(steps: &mut Steps) {
    let name = |step: &str| ros::step(&format!("bridge-ros{step}"));
    let Some(mut environment) = r2r::environment_of(steps, &name("")) else { return };
    // r2r does not know the name; of its crates the bridge uses the one that binds whatever headers there are.
    for (_, distribution) in environment.iter_mut().filter(|(_, value)| value == "kilted") {
        *distribution = "rolling".to_owned();
    }
    lints::build_with(steps, &name(": build and lints"), &format!("{WHOLE} {TARGETS}"), |command| {
        with_libraries(&environment, command)
    });
    // The program that starts it, which says what is wrong when ROS or the loader ends it; and what carries a domain's topics to
    // another host.
    steps.command(&name(": taut and the gateway"), &mut lints::cargo(&programs()));
    let is_usual = ros::chosen() == Distribution::default();
    let mut tests = lints::cargo(&nextest(WHOLE));
    if !is_usual && machine::is_ci() && machine::cargo_has("nextest --version").is_ok() {
        tests.args(["-E", OF_DISTRIBUTION]);
    }
    steps.command(&name(": tests"), with_ros(&environment, &mut tests));
    if is_usual {
        let mut doc_tests = lints::cargo(&format!("test {WHOLE} --doc"));
        steps.command("bridge-ros: doc tests", with_ros(&environment, &mut doc_tests));
    } else {
        forget_r2r();
    }
}

/// The tests of what headers, types and graph of a distribution decide. The rest takes as long again, and CI runs it with the usual distribution only:
/// threads, chains of bridges, crashes, errors, bridges in nodes, `taut` as a client.
const OF_DISTRIBUTION: &str = "not binary(/^(chain|composed|crashes|errors|threads|tools)$/)";

/// What r2r's build script has made, which it finds and says nothing of when it runs once more: with the bindings of the usual distribution again,
/// it is to begin anew.
fn forget_r2r() {
    let made = std::fs::read_dir(Build::Tests.folder().join("build")).into_iter().flatten().flatten();
    for folder in made.filter(|entry| entry.file_name().to_string_lossy().starts_with("r2r-")) {
        let _ = std::fs::remove_dir_all(folder.path());
    }
}

const BRIDGE: &str = "--manifest-path bridge-ros/Cargo.toml --locked";

/// With what it needs as the workspace's tests have it.
pub const WHOLE: &str = "--manifest-path bridge-ros/Cargo.toml --locked --features xtask";

/// The bench, of a release build with the bridge and r2r's side, some minutes from cold.
pub fn bench(of: Build) -> Result<Command, String> {
    let environment = r2r::environment()?;
    of.with(with_libraries(&environment, &mut cargo(&format!("build --release {BRIDGE} --bins"))))?;
    let program = lab::folder_with_ros(of, &environment, "-p tautline-bench-bridge")?.join("bench-bridge");
    let mut command = Command::new(&program);
    if of == Build::Tests {
        // It waits for processes, which may not come.
        command = Command::new("timeout");
        command.arg("300").arg(program);
    }
    // The bridge finds types where this says.
    command.envs(environment);
    Ok(command)
}
