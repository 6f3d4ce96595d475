// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge to ROS 2: its lints and its tests, against the ROS 2 that is sourced or the one under the target directory.

use crate::steps::{Outcome, Steps, cargo};
use crate::{machine, r2r};
use std::process::{Command, ExitCode};

/// `cargo xtask bridge`.
pub fn run() -> ExitCode {
    let mut steps = Steps::new();
    test(&mut steps);
    steps.finish()
}

/// Without a ROS 2 it is left out, which is said; but not in CI.
pub fn test(steps: &mut Steps) {
    let mut environment = Vec::new();
    let prepared = steps.step("bridge-ros: ROS 2", || match r2r::environment() {
        Ok(variables) => {
            environment = variables;
            Outcome::Ok
        }
        Err(reason) if machine::is_ci() => Outcome::Failed(reason),
        Err(reason) => Outcome::Skipped(reason),
    });
    if !prepared {
        return steps
            .skip("bridge-ros", "there is no ROS 2 to build it with: source one, or run `cargo xtask ros`");
    }
    let bridge = |arguments: &str| -> Command {
        let mut command = cargo(arguments);
        // The workspace's, with which it shares all but the bindings.
        command.envs(environment.clone()).env("CARGO_TARGET_DIR", machine::target_dir());
        command
    };
    let manifest = "--manifest-path bridge-ros/Cargo.toml --locked";
    steps.command(
        "bridge-ros: clippy",
        &mut bridge(&format!("clippy {manifest} --all-targets -- -D warnings")),
    );
    let mut doc = bridge(&format!("doc {manifest} --no-deps"));
    steps.command("bridge-ros: doc", doc.env("RUSTDOCFLAGS", "-Dwarnings"));
    // Of processes, several of which at once find each other late on a small machine.
    steps.command(
        "bridge-ros: tests",
        &mut bridge(&format!("test {manifest} --no-fail-fast -- --test-threads 2")),
    );
}
