// SPDX-License-Identifier: MIT OR Apache-2.0
//! The laboratory, `benches/`: a workspace of its own, which is built into the product's target directory.

use crate::build::{Build, TARGETS};
use crate::r2r::Environment;
use crate::steps::{self, Steps, cargo_with};
use crate::with_ros::{nextest, with_libraries};
use crate::{lints, machine, r2r};
use std::path::PathBuf;
use std::process::Command;

/// Its packages that need no ROS 2 and no other middleware than iceoryx2, with what they need as the product's tests have it.
pub const WHOLE: &str = "--manifest-path benches/Cargo.toml --locked --features tautline-benches/xtask";

/// The other middleware that takes at most minutes to build, with what it needs as the product's tests have it. hiroz takes another Zenoh for
/// its build script.
const RIVALS: &str = "--manifest-path benches/Cargo.toml --locked -p tautline-benches -p rival-zenoh -p rival-taktora \
    --features tautline-benches/xtask";

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
    of.with(&mut cargo(&format!("build --release {packages}")))
}

/// As [`folder_with`], with a ROS 2.
pub fn folder_with_ros(of: Build, environment: &Environment, packages: &str) -> Result<PathBuf, String> {
    of.with(with_libraries(environment, &mut cargo(&format!("build --release {packages}"))))
}

/// Builds r2r's side of the benches, a minute from cold, and says where this program of it is.
pub fn r2r_program(name: &str, of: Build) -> Result<PathBuf, String> {
    Ok(folder_with_ros(of, &r2r::environment()?, "-p rival-r2r")?.join(name))
}

/// Tells a bench where r2r's side of it is, built before, or why it is left out.
pub fn join_r2r(bench: &mut Command, name: &str, is_left_out: bool, of: Build) {
    let built = if is_left_out { Err("as --no-r2r says".to_owned()) } else { r2r_program(name, of) };
    match built {
        Ok(program) => bench.arg("--r2r").arg(program),
        Err(reason) => bench.arg(format!("--without-r2r={reason}")),
    };
}

/// Builds what needs no ROS 2, and runs its tests. Says whether it was built.
pub fn test(steps: &mut Steps) -> bool {
    let target = ("CARGO_TARGET_DIR", machine::target_dir());
    steps.command("benches: fmt", &mut steps::cargo("fmt --manifest-path benches/Cargo.toml --all --check"));
    let mut build = |name: &str, targets: &str| {
        lints::build_with(steps, name, targets, |command| command.env(target.0, &target.1))
    };
    let built = [
        build("benches: build and lints", &format!("{WHOLE} {TARGETS}")),
        build("benches: rivals", &format!("{RIVALS} --lib --bins")),
    ];
    let mut tests = lints::cargo(&nextest(WHOLE));
    steps.command("benches: tests", tests.env(target.0, &target.1));
    built == [true, true]
}

/// Builds and lints what needs this ROS 2.
pub fn build_with_ros(steps: &mut Steps, environment: &Environment) {
    let name = "benches with ROS 2: build and lints";
    lints::build_with(steps, name, &format!("{WITH_ROS} --lib --bins"), |command| {
        with_libraries(environment, command)
    });
}
