// SPDX-License-Identifier: MIT OR Apache-2.0
//! The programs of the test `programs` of `tautline-r2r` on r2r itself: what they expect of Tautline is what they get there.

use crate::bridge::{with_libraries, with_ros};
use crate::r2r::{self, Environment};
use crate::steps::{Outcome, Steps, cargo, execute};

/// With what they need as the workspace's tests have it.
pub const WHOLE: &str = "--manifest-path node/r2r/Cargo.toml --locked";

/// Those that the programs and the benches use, which share a build of r2r; all of ROS's take minutes.
pub const PACKAGES: &str = "action_msgs;builtin_interfaces;geometry_msgs;nav_msgs;rcl_interfaces;rosgraph_msgs;sensor_msgs;\
    service_msgs;std_msgs;std_srvs;test_msgs;type_description_interfaces;unique_identifier_msgs;visualization_msgs";

/// A minute from cold. Without a network and without a ROS 2 it is left out, but not in CI.
pub fn test(steps: &mut Steps) {
    steps.step("r2r: programs", || Outcome::with(r2r::environment(), |environment| run_on(&environment)));
}

fn run_on(r2r: &Environment) -> Result<(), String> {
    execute(with_libraries(r2r, &mut cargo(&format!("test {WHOLE} --no-run"))))?;
    execute(with_ros(r2r, &mut cargo(&format!("test {WHOLE} --no-fail-fast"))))
}
