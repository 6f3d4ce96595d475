// SPDX-License-Identifier: MIT OR Apache-2.0
//! rmw_tautline: built for use, its lints and tests.

pub mod cross;

use crate::build::{Build, TARGETS, build};
use crate::r2r::Environment;
use crate::ros::Distribution;
use crate::steps::{Steps, cargo};
use crate::with_ros::{RMW, nextest, programs, with_libraries};
use crate::{colcon, headers, lab, lints, peers, r2r, ros};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

const LIBRARY: &str = "--manifest-path rmw/Cargo.toml --locked";

/// The bench, of a release build with the library that is made first.
pub fn bench(of: Build) -> Result<Command, String> {
    let environment = if of == Build::Release { build_for_use()? } else { r2r::environment()? };
    let folder = lab::folder_with_ros(of, &environment, "-p tautline-bench-rmw")?;
    // It waits for processes, which may not come.
    let mut command = Command::new("timeout");
    command.arg("600").arg(folder.join("bench-rmw")).arg("--tautline").arg(folder.join("librmw_tautline.so"));
    if let Some(python) = python() {
        command.arg("--python").arg(python);
    }
    Ok(command)
}

/// The one that has rclpy: with the ROS 2 that is sourced, else with that under the target directory.
fn python() -> Option<PathBuf> {
    let own = ros::folder();
    let is_sourced = |prefixes: OsString| !Path::new(&prefixes).starts_with(&own);
    if std::env::var_os("AMENT_PREFIX_PATH").is_some_and(is_sourced) {
        return Some("python3".into());
    }
    Some(ros::venv().join("bin/python")).filter(|python| python.is_file())
}

/// The library, and the environment that it was built in.
pub fn build_for_use() -> Result<Environment, String> {
    let environment = r2r::environment()?;
    build(with_libraries(&environment, &mut cargo(&format!("build --release {LIBRARY}"))))?;
    Ok(environment)
}

/// Builds the library for use, a minute from cold, and says how it is used.
pub fn run() -> Result<(), String> {
    let environment = build_for_use()?;
    let folder = Build::Release.folder();
    println!("\nTo run a node of ROS 2 on it:");
    if !environment.iter().any(|(name, _)| *name == r2r::RPATH) {
        println!("  export LD_LIBRARY_PATH={}:$LD_LIBRARY_PATH", folder.display());
        println!("  export RMW_IMPLEMENTATION=rmw_tautline");
    } else {
        println!("  . {}", ros::venv().join("bin/activate").display());
        // rcl of these packages is linked to another RMW, whose place it takes.
        let library = folder.join("librmw_tautline.so");
        println!("  export RMW_IMPLEMENTATION=rmw_tautline LD_PRELOAD={}", library.display());
    }
    println!("What differs from other RMWs: docs/rmw.md");
    Ok(())
}

/// Without a ROS 2 it is left out, which is said; but not in CI. With another than the usual one also what needs builds that this one
/// replaces, or two distributions. Says whether the build has the chosen one's library.
pub fn test(steps: &mut Steps) -> bool {
    let Some(environment) = r2r::environment_of(steps, &ros::step("rmw")) else { return false };
    let is_second = ros::chosen() != Distribution::default();
    if is_second {
        headers::test(steps, &environment);
    }
    let step = ros::step("rmw: build and lints");
    let is_built = lints::build_with(steps, &step, &format!("{RMW} {TARGETS}"), |command| {
        with_libraries(&environment, command)
    });
    if is_second {
        headers::refused(steps, &ros::distribution(), Distribution::default());
    }
    colcon::test(steps, &environment);
    steps.command(&ros::step("rmw: the gateway"), &mut lints::cargo(&programs()));
    steps.step(&ros::step("rmw: zenoh-ros2-sdk"), peers::prepare);
    let mut tests = lints::cargo(&nextest(RMW));
    steps.command(&ros::step("rmw: tests"), with_libraries(&environment, &mut tests));
    is_built
}
