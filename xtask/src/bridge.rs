// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge to ROS 2: its lints and its tests, against the ROS 2 that is sourced or the one under the target directory.

use crate::steps::{self, Outcome, Steps, cargo, execute};
use crate::{machine, r2r};
use std::path::PathBuf;
use std::process::{Command, ExitCode};

#[derive(clap::Args)]
#[command(after_help = "Examples:
  cargo xtask bench bridge                  20 topics at 1 kHz, 30 s each way
  cargo xtask bench bridge --quick          2 s each way
  cargo xtask bench bridge -- --topics 5 --rate 100 --no-rt")]
pub struct Options {
    /// Two seconds each way
    #[arg(long)]
    pub quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Passed on: see `cargo xtask bench bridge -- --help`
    #[arg(last = true)]
    pub arguments: Vec<String>,
}

/// Builds the bridge and r2r's side, and measures.
pub fn bench(options: &Options) -> ExitCode {
    let environment = match build() {
        Ok(environment) => environment,
        Err(reason) => {
            eprintln!("bench bridge: {reason}");
            return ExitCode::FAILURE;
        }
    };
    let mut command = Command::new(machine::target_dir().join("release/bench-bridge"));
    // The bridge finds types where this says.
    command.envs(environment);
    if options.quick {
        command.args(["--seconds", "2"]);
    }
    if let Some(path) = &options.json {
        command.arg("--json").arg(path);
    }
    steps::run(command.args(&options.arguments))
}

/// Some minutes from cold. Returns what its programs need to run as well.
fn build() -> Result<Vec<(&'static str, String)>, String> {
    let mut build =
        cargo("build --release --locked --manifest-path bridge-ros/Cargo.toml --features bench --bins");
    let environment = r2r::environment()?;
    if let Some((_, lib)) = environment.iter().find(|(name, _)| *name == r2r::RPATH) {
        // r2r's build script needs the libraries too, and has no rpath.
        build.env("LD_LIBRARY_PATH", lib);
    }
    build.envs(environment.clone()).env("CARGO_TARGET_DIR", machine::target_dir());
    // The messages that it uses; all of them take minutes.
    match execute(build.env("IDL_PACKAGE_FILTER", "std_msgs")) {
        Outcome::Ok => Ok(environment),
        Outcome::Failed(reason) | Outcome::Skipped(reason) => Err(format!("the build failed: {reason}")),
    }
}

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
