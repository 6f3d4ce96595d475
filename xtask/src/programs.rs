// SPDX-License-Identifier: MIT OR Apache-2.0
//! The programs of the test `programs` of `tautline-r2r` on r2r itself: what they expect of Tautline is what they get there.

use crate::steps::{Outcome, Steps, execute};
use crate::{machine, r2r};
use std::process::ExitCode;

/// Those that the programs use; all of them take minutes.
const PACKAGES: &str = "action_msgs;builtin_interfaces;geometry_msgs;rcl_interfaces;rosgraph_msgs;service_msgs;std_msgs;\
    std_srvs;test_msgs;type_description_interfaces;unique_identifier_msgs";

/// `cargo xtask r2r`.
pub fn run() -> ExitCode {
    let mut steps = Steps::new();
    test(&mut steps);
    steps.finish()
}

/// Three minutes from cold. Without a network and without a ROS 2 it is left out, but not in CI.
pub fn test(steps: &mut Steps) {
    steps.step("r2r: programs", || {
        let mut tests = match r2r::cargo("test --locked --no-fail-fast") {
            Ok(tests) => tests,
            Err(reason) if machine::is_ci() => return Outcome::Failed(reason),
            Err(reason) => return Outcome::Skipped(reason),
        };
        tests.arg("--manifest-path").arg(machine::root().join("node/r2r/Cargo.toml"));
        tests.arg("--target-dir").arg(machine::target_dir().join("ros/r2r-programs"));
        execute(tests.env("IDL_PACKAGE_FILTER", PACKAGES))
    });
}
