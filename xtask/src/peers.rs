// SPDX-License-Identifier: MIT OR Apache-2.0
//! The gateway with peers that are not ours: hiroz in a workspace of its own, zenoh-ros2-sdk in a Python environment under
//! the target directory, and rmw_zenoh_cpp where it is installed.

use crate::machine::{self, Scope};
use crate::running::Running;
use crate::steps::{Outcome, Steps, cargo};
use crate::with_ros::{RMW, nextest, with_libraries};
use crate::{lints, r2r, ros};
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

/// Longer than the listener listens.
const PATIENCE: Duration = Duration::from_secs(120);

const WHEELS: [&str; 2] = ["zenoh-ros2-sdk==0.1.8", "xxhash==4.1.0"];

/// `cargo xtask peers`.
pub fn build_and_test(steps: &mut Steps) {
    steps.command("examples", &mut lints::cargo("build -p tautline-examples --examples"));
    steps.command("gateway", &mut lints::cargo("build -p tautline-gateway"));
    steps.step("peers: zenoh-ros2-sdk", prepare);
    test(steps);
    nodes_of_ros(steps);
}

/// The RMW's tests with zenoh-ros2-sdk, and with the rmw_zenoh_cpp that `TAUT_RMW_ZENOH` names, or that of the ROS 2 that is sourced.
fn nodes_of_ros(steps: &mut Steps) {
    const NAME: &str = "peers: rmw_zenoh_cpp";
    let name = ros::step("peers: rmw_tautline");
    let Some(environment) = r2r::environment_of(steps, &name) else { return };
    let mut library = lints::cargo(&format!("build {RMW}"));
    steps.command(&format!("{name}: build"), with_libraries(&environment, &mut library));
    let mut test = |name: &str, test: &str| {
        let mut tests = lints::cargo(&nextest(&format!("{RMW} --test {test}")));
        steps.command(name, with_libraries(&environment, &mut tests));
    };
    test(&name, "peers");
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    let sourced = std::env::split_paths(&prefixes).map(|prefix| prefix.join("lib/librmw_zenoh_cpp.so"));
    let named = std::env::var_os("TAUT_RMW_ZENOH").map(PathBuf::from);
    if !named.into_iter().chain(sourced).any(|library| library.is_file()) {
        return steps.skip(NAME, "no ROS 2 that is sourced has its library, and TAUT_RMW_ZENOH names none");
    }
    test(NAME, "zenoh");
}

/// Runs the tests and an example in the environment of [`prepare`], with the gateway and the examples of the tests' build.
pub fn test(steps: &mut Steps) {
    let mut tests = cargo("test --manifest-path transport/zenoh/peers/Cargo.toml --no-fail-fast");
    // The workspace's, with which it shares all but hiroz and hiroz's Zenoh.
    tests.env("CARGO_TARGET_DIR", machine::target_dir());
    tests.env("TAUT_PEERS_VENV", venv());
    steps.command("peers: tests", &mut tests);
    let example = "example ros2_talker";
    if venv().join("wheels.txt").exists() {
        steps.step(example, ros2_talker);
    } else {
        steps.skip(example, "there is no zenoh-ros2-sdk");
    }
}

/// The example talks, through a gateway of the tests' build, to a listener that is not ours.
fn ros2_talker() -> Result<(), String> {
    const PORT: &str = "7453";
    // On the wire it is the peers'.
    const DOMAIN: &str = "0";
    // Both are killed.
    let scope = Scope::new("peers");
    let target = machine::target_dir();
    let mut gateway = Command::new(target.join("debug/taut-gateway"));
    gateway.args(["--domain", DOMAIN, "--listen", &format!("tcp/127.0.0.1:{PORT}"), "--no-rt", "--json"]);
    let _gateway = Running::start(gateway.env("TAUT_SCOPE", scope.name()), false)?;
    let mut talker = Command::new(target.join("debug/examples/ros2_talker"));
    talker.env("TAUT_SCOPE", scope.name()).env("TAUT_DOMAIN", DOMAIN).env("TAUT_REALTIME", "off");
    let _talker = Running::start(&mut talker, false)?;
    // It ends by itself if it hears nothing.
    let mut listener = Command::new(venv().join("bin/python"));
    listener.arg(machine::root().join("transport/zenoh/peers/python/listener.py")).args([PORT, DOMAIN]);
    let mut listener = Running::start(&mut listener, false)?;
    let has_heard = |said: &str| said.contains("I heard: [Hello World: ");
    listener.wait_until(Instant::now() + PATIENCE, has_heard);
    let said = listener.said();
    print!("{said}");
    if has_heard(&said) { Ok(()) } else { Err("the listener heard nothing".to_owned()) }
}

fn venv() -> PathBuf {
    machine::target_dir().join("peers/venv")
}

/// Makes the environment unless it is there already: some 60 MB from PyPI. Without a network the Python peer is left out, but not in CI.
pub fn prepare() -> Outcome {
    Outcome::from(ros::make_venv(&venv(), &WHEELS, || Ok("python3".to_owned()))).unless_ci()
}
