// SPDX-License-Identifier: MIT OR Apache-2.0
//! The laboratory, `benches/`: a workspace of its own, which is built into the product's target directory.

use crate::build::{Build, TARGETS, build};
use crate::r2r::Environment;
use crate::steps::{self, Steps, cargo_with};
use crate::{bridge, lints, machine};
use std::path::PathBuf;
use std::process::Command;

/// Its packages that need no ROS 2, the other middleware among them, with what they need as the product's tests have it.
pub const WHOLE: &str = "--manifest-path benches/Cargo.toml --locked --workspace --exclude tautline-bench-bridge \
    --exclude tautline-bench-rmw --exclude rival-r2r --features tautline-benches/xtask";

/// Its packages that need a ROS 2. What they need has the product's features through the first.
pub const WITH_ROS: &str = "--manifest-path benches/Cargo.toml --locked -p tautline-benches -p tautline-bench-bridge \
    -p tautline-bench-rmw -p rival-r2r --features tautline-benches/xtask";

/// `cargo` for the laboratory with these arguments, by which it would build beside its manifest otherwise.
fn cargo(arguments: &str) -> Command {
    let (verb, rest) = arguments.split_once(' ').unwrap_or((arguments, ""));
    let target = format!("--target-dir={}", machine::target_dir().display());
    cargo_with(&format!("{verb} --manifest-path benches/Cargo.toml --locked {rest}"), [target])
}

/// Runs a program of a package.
pub fn program(of: Build, package: &str, name: &str) -> Command {
    match of {
        Build::Release => cargo(&format!("run --release -p {package} --bin {name} --")),
        Build::Tests => Command::new(of.folder().join(name)),
    }
}

/// Builds packages, `-p` before each, for a release; those of the tests' build are there. Says where they are.
pub fn folder_with(of: Build, packages: &str) -> Result<PathBuf, String> {
    if of == Build::Release {
        build(&mut cargo(&format!("build --release {packages}")))?;
    }
    Ok(of.folder())
}

/// As [`folder_with`], with a ROS 2.
pub fn folder_with_ros(of: Build, environment: &Environment, packages: &str) -> Result<PathBuf, String> {
    if of == Build::Release {
        build(bridge::with_libraries(environment, &mut cargo(&format!("build --release {packages}"))))?;
    }
    Ok(of.folder())
}

/// Builds all of it that needs no ROS 2, and runs its tests.
pub fn test(steps: &mut Steps) -> bool {
    let in_target = |command: &mut Command| {
        command.env("CARGO_TARGET_DIR", machine::target_dir());
    };
    steps.command("benches: fmt", &mut steps::cargo("fmt --manifest-path benches/Cargo.toml --all --check"));
    let built =
        lints::build_with(steps, "benches: build and lints", &format!("{WHOLE} {TARGETS}"), |command| {
            in_target(command);
            command
        });
    let mut tests = lints::cargo(&bridge::nextest(WHOLE));
    in_target(&mut tests);
    steps.command("benches: tests", &mut tests);
    built
}

/// Builds what needs a ROS 2. Without one it is left out, which is said; but not in CI.
pub fn build_with_ros(steps: &mut Steps, environment: &Environment) {
    lints::build_with(
        steps,
        "benches with ROS 2: build and lints",
        &format!("{WITH_ROS} --lib --bins"),
        |command| bridge::with_libraries(environment, command),
    );
}
