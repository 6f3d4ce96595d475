// SPDX-License-Identifier: MIT OR Apache-2.0
//! rmw_tautline: built for use, its lints and tests, and its bench.

use crate::bridge::{Environment, nextest, programs, with_libraries};
use crate::steps::{self, Outcome, Steps, cargo, execute};
use crate::{colcon, machine, r2r, ros};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

const LIBRARY: &str = "--manifest-path rmw/Cargo.toml --locked";
/// With the bench.
const BENCH: &str = "--manifest-path rmw/Cargo.toml --locked --features bench";
/// With the bench, and what it needs as the workspace's tests have it.
pub const WHOLE: &str = "--manifest-path rmw/Cargo.toml --locked --features bench,xtask";

#[derive(clap::Args)]
#[command(after_help = "Examples:
  cargo xtask bench rmw
  cargo xtask bench rmw --quick --json rmw.json")]
pub struct Options {
    /// Fewer and shorter rounds: half a minute instead of five
    #[arg(long)]
    pub quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Passed on: see `cargo xtask bench rmw -- --help`
    #[arg(last = true)]
    pub arguments: Vec<String>,
}

/// Builds it and its bench, and measures.
pub fn bench(options: &Options) -> ExitCode {
    let built = r2r::environment().and_then(|environment| {
        match execute(&mut with_libraries(&environment, &format!("build --release {BENCH}"))) {
            Outcome::Ok => Ok(()),
            Outcome::Failed(reason) | Outcome::Skipped(reason) => Err(reason),
        }
    });
    if let Err(reason) = built {
        eprintln!("bench rmw: {reason}");
        return ExitCode::FAILURE;
    }
    steps::run(measure("release", options.quick, options.json.as_deref()).args(&options.arguments))
}

fn measure(profile: &str, quick: bool, json: Option<&Path>) -> Command {
    let folder = machine::target_dir().join(profile);
    // It waits for processes, which may not come.
    let mut command = Command::new("timeout");
    command.arg("600").arg(folder.join("bench-rmw")).arg("--tautline").arg(folder.join("librmw_tautline.so"));
    command.args(quick.then_some("--quick"));
    if let Some(python) = python() {
        command.arg("--python").arg(python);
    }
    if let Some(path) = json {
        command.arg("--json").arg(path);
    }
    command
}

/// The one that has rclpy: with the ROS 2 that is sourced, else with that under the target directory.
fn python() -> Option<PathBuf> {
    let own = machine::target_dir().join("ros");
    let is_sourced = |prefixes: OsString| !Path::new(&prefixes).starts_with(&own);
    if std::env::var_os("AMENT_PREFIX_PATH").is_some_and(is_sourced) {
        return Some("python3".into());
    }
    Some(ros::venv().join("bin/python")).filter(|python| python.is_file())
}

/// Nothing is lost, with the build of the tests; how it compares is for a quiet machine and a release build.
pub fn bench_of_tests(steps: &mut Steps) {
    let mut command = measure("debug", true, Some(&machine::target_dir().join("rmw.json")));
    if !machine::is_ci() && !machine::realtime_permitted() {
        command.arg("--no-rt");
    }
    steps.command("bench: rmw", &mut command);
}

/// Builds the library for use, a minute from cold, and says how it is used.
pub fn run() -> ExitCode {
    match build() {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("rmw_tautline is not built: {reason}");
            ExitCode::FAILURE
        }
    }
}

fn build() -> Result<(), String> {
    let environment = r2r::environment()?;
    match execute(&mut with_libraries(&environment, &format!("build --release {LIBRARY}"))) {
        Outcome::Ok => {}
        Outcome::Failed(reason) | Outcome::Skipped(reason) => return Err(reason),
    }
    let folder = machine::target_dir().join("release");
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

/// Without a ROS 2 it is left out, which is said; but not in CI.
pub fn test(steps: &mut Steps) {
    let mut environment = Environment::new();
    let prepared = steps.step("rmw: ROS 2", || match r2r::environment() {
        Ok(variables) => {
            environment = variables;
            Outcome::Ok
        }
        Err(reason) if machine::is_ci() => Outcome::Failed(reason),
        Err(reason) => Outcome::Skipped(reason),
    });
    if !prepared {
        return steps.skip("rmw", "there is no ROS 2 to build it with: source one, or run `cargo xtask ros`");
    }
    let building = |arguments: &str| with_libraries(&environment, arguments);
    steps.command("rmw: clippy", &mut building(&format!("clippy {WHOLE} --all-targets -- -D warnings")));
    // Cargo builds no library of this kind for its tests.
    steps.command("rmw: build", &mut building(&format!("build {WHOLE}")));
    colcon::test(steps, &environment);
    steps.command("rmw: the gateway", &mut cargo(&programs()));
    steps.command("rmw: tests", &mut building(&nextest(WHOLE)));
}
