// SPDX-License-Identifier: MIT OR Apache-2.0
//! What builds and tests of the workspaces that need a ROS 2 have in common.

use crate::build::WHOLE;
use crate::machine;
use crate::r2r::{Environment, RPATH};
use std::process::Command;

/// The RMW, with what it needs as the workspace's tests have it.
pub const RMW: &str = "--manifest-path rmw/Cargo.toml --locked --features xtask";

/// The packages of messages that the programs and the benches use, which share a build of r2r; all of ROS's take minutes.
const PACKAGES: &str = "action_msgs;builtin_interfaces;geometry_msgs;nav_msgs;rcl_interfaces;rosgraph_msgs;sensor_msgs;\
    service_msgs;std_msgs;std_srvs;test_msgs;type_description_interfaces;unique_identifier_msgs;visualization_msgs";

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
    format!(
        "build --locked {WHOLE} --bin taut --bin taut-bag --bin taut-top --bin taut-gateway --test component"
    )
}

/// With the ROS 2 of this environment, for what shares the workspace's target directory.
pub fn with_ros<'c>(environment: &Environment, command: &'c mut Command) -> &'c mut Command {
    command.envs(environment.clone()).env("CARGO_TARGET_DIR", machine::target_dir());
    command.env("IDL_PACKAGE_FILTER", PACKAGES)
}

/// For a build: r2r's build script needs the libraries too, and has no rpath.
pub fn with_libraries<'c>(environment: &Environment, command: &'c mut Command) -> &'c mut Command {
    let lib = environment.iter().find(|(name, _)| *name == RPATH);
    with_ros(environment, command).envs(lib.map(|(_, lib)| ("LD_LIBRARY_PATH", lib)))
}
