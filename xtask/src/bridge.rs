// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge to ROS 2: its lints and its tests, against the ROS 2 that is sourced or the one under the target directory.

use crate::bench::Options;
use crate::build::{TARGETS, WHOLE as WORKSPACE, build};
use crate::r2r::Environment;
use crate::reports::BRIDGE;
use crate::steps::{Outcome, Steps, cargo, reported};
use crate::{lints, machine, programs, r2r};
use std::process::Command;

#[derive(clap::Args)]
#[command(after_help = "Examples:
  cargo xtask bench bridge                  20 topics at 1 kHz, 30 s each way
  cargo xtask bench bridge --quick          2 s each way
  cargo xtask bench bridge -- --fit         on a machine that has no room for this to ROS
  cargo xtask bench bridge -- --topics 5 --rate 100 --no-rt")]
pub struct Bridge {
    #[command(flatten)]
    bench: Options,
}

impl Bridge {
    /// Builds the bridge and r2r's side, some minutes from cold, and makes the command that measures.
    pub fn command(&self) -> Result<Command, String> {
        let environment = r2r::environment()?;
        build(with_libraries(&environment, &mut cargo(&format!("build --release {BENCH} --bins"))))?;
        let mut command = Command::new(machine::target_dir().join("release/bench-bridge"));
        // The bridge finds types where this says.
        command.envs(environment);
        self.bench.pass_on(&mut command, &["--seconds", "2"]);
        Ok(command)
    }
}

/// Without a ROS 2 it is left out, which is said; but not in CI.
pub fn test(steps: &mut Steps) {
    let Some(environment) = r2r::environment_of(steps, "bridge-ros") else { return };
    // With the bench, which is linted too, and measures in a step of its own.
    lints::build_with(steps, "bridge-ros: build and lints", &format!("{WHOLE} {TARGETS}"), |command| {
        with_libraries(&environment, command)
    });
    // The program that starts it, which says what is wrong when ROS or the loader ends it; and what carries a domain's topics to
    // another host.
    steps.command("bridge-ros: taut and the gateway", &mut lints::cargo(&programs()));
    steps.command("bridge-ros: tests", with_ros(&environment, &mut lints::cargo(&nextest(WHOLE))));
    let mut doc_tests = lints::cargo(&format!("test {WHOLE} --doc"));
    steps.command("bridge-ros: doc tests", with_ros(&environment, &mut doc_tests));
}

/// Tests of processes, several of which at once find each other late on a small machine: what fails once is tried again, and named.
pub fn nextest(whole: &str) -> String {
    if machine::cargo_has("nextest --version").is_err() {
        return format!("test {whole} --lib --bins --tests --no-fail-fast -- --test-threads 2");
    }
    let profile = if machine::is_ci() { "ci" } else { "default" };
    format!(
        "nextest run {whole} --config-file .config/nextest.toml --profile {profile} --no-fail-fast --test-threads 2"
    )
}

/// The workspace's programs that tests elsewhere run. With a test and the features of the workspace's tests, by which cargo takes
/// the features that these have of everything, and builds nothing twice.
pub fn programs() -> String {
    format!("build --locked {WORKSPACE} --bin taut --bin taut-gateway --test component")
}

/// With the bench.
const BENCH: &str = "--manifest-path bridge-ros/Cargo.toml --locked --features bench";

/// With the bench, and what it needs as the workspace's tests have it.
pub const WHOLE: &str = "--manifest-path bridge-ros/Cargo.toml --locked --features bench,xtask";

/// With the ROS 2 of this environment, for what shares the workspace's target directory.
pub fn with_ros<'c>(environment: &Environment, command: &'c mut Command) -> &'c mut Command {
    command.envs(environment.clone()).env("CARGO_TARGET_DIR", machine::target_dir());
    command.env("IDL_PACKAGE_FILTER", programs::PACKAGES)
}

/// For a build: r2r's build script needs the libraries too, and has no rpath.
pub fn with_libraries<'c>(environment: &Environment, command: &'c mut Command) -> &'c mut Command {
    let lib = environment.iter().find(|(name, _)| *name == r2r::RPATH);
    with_ros(environment, command).envs(lib.map(|(_, lib)| ("LD_LIBRARY_PATH", lib)))
}

/// 20 topics at 1 kHz lose nothing in 15 s each way, or to ROS in so much longer as the machine needs, with the build of the tests: what
/// the bridge adds is printed beside r2r's own subscriber, and belongs to the machine and the build.
pub fn bench_of_tests(steps: &mut Steps) {
    let target = machine::target_dir();
    let json = target.join("bridge.json");
    steps.step("bench: bridge", || {
        let environment = match r2r::environment() {
            Ok(environment) => environment,
            Err(reason) => return Outcome::Failed(reason).unless_ci(),
        };
        // It waits for processes, which may not come.
        let mut command = Command::new("timeout");
        command
            .arg("300")
            .arg(target.join("debug/bench-bridge"))
            .args(["--seconds", "15", "--fit"])
            .arg("--json")
            .arg(&json)
            .envs(environment);
        command.args(machine::no_rt());
        reported(&mut command, &json, || BRIDGE.of(&json, &[("expected", (20 * 1000 * 15).into())])).into()
    });
}
