// SPDX-License-Identifier: MIT OR Apache-2.0
//! The programs of the test `programs` of `tautline-r2r` on r2r itself: what they expect of Tautline is what they get there.

use crate::r2r::{self, Environment};
use crate::steps::{Outcome, Steps, cargo, execute};
use crate::with_ros::{with_libraries, with_ros};

/// With what they need as the workspace's tests have it.
pub const WHOLE: &str = "--manifest-path node/r2r/Cargo.toml --locked";

/// A minute from cold. Without a network and without a ROS 2 it is left out, but not in CI.
pub fn test(steps: &mut Steps) {
    steps.step("r2r: programs", || Outcome::with(r2r::environment(), |environment| run_on(&environment)));
}

fn run_on(r2r: &Environment) -> Result<(), String> {
    execute(with_libraries(r2r, &mut cargo(&format!("test {WHOLE} --no-run"))))?;
    execute(with_ros(r2r, &mut cargo(&format!("test {WHOLE} --no-fail-fast"))))
}
