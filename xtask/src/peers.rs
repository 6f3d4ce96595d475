// SPDX-License-Identifier: MIT OR Apache-2.0
//! The gateway with others: hosts in network namespaces, hostile peers, and peers that are not ours: hiroz in a workspace
//! of its own, zenoh-ros2-sdk in a Python environment under the target directory.

use crate::machine;
use crate::steps::{Outcome, Steps, announce, cargo, execute};
use std::fs;
use std::process::{Command, ExitCode};

const WHEELS: [&str; 2] = ["zenoh-ros2-sdk==0.1.8", "xxhash==4.1.0"];

/// Makes the environment and runs the tests, one at a time: hosts of different tests must not find each other. No part of
/// `cargo xtask test`: it builds hiroz, which brings all of Zenoh once more. Without a network the Python peer is left out,
/// but not in CI.
pub fn run() -> ExitCode {
    let mut steps = Steps::new();
    steps.command(
        "peers: hosts",
        &mut cargo("test -p tautline-gateway --tests --no-fail-fast -- --test-threads=1"),
    );
    steps.step("peers: zenoh-ros2-sdk", || match prepare() {
        Outcome::Failed(reason) if !machine::is_ci() => Outcome::Skipped(reason),
        other => other,
    });
    let mut tests = cargo("test --manifest-path transport/zenoh/peers/Cargo.toml --no-fail-fast");
    tests.env("CARGO_TARGET_DIR", machine::target_dir().join("peers/build"));
    tests.env("TAUT_PEERS_VENV", machine::target_dir().join("peers/venv"));
    steps.command("peers: tests", &mut tests);
    steps.finish()
}

/// Makes the environment unless it is there already: some 60 MB from PyPI.
fn prepare() -> Outcome {
    let venv = machine::target_dir().join("peers/venv");
    // Written last: what was interrupted is made anew.
    let complete = venv.join("wheels.txt");
    let wheels = WHEELS.join("\n");
    if fs::read_to_string(&complete).is_ok_and(|text| text == wheels) {
        return Outcome::Ok;
    }
    if venv.exists()
        && let Err(error) = fs::remove_dir_all(&venv)
    {
        return Outcome::Failed(error.to_string());
    }
    let mut make = Command::new("python3");
    make.args(["-m", "venv"]).arg(&venv);
    announce(&make);
    match make.status() {
        Ok(status) if status.success() => {}
        Ok(status) => return Outcome::Failed(format!("python3 -m venv: {status}")),
        Err(error) => return Outcome::Failed(format!("python3: {error}")),
    }
    let mut install = Command::new(venv.join("bin/pip"));
    install.args(["install", "--quiet", "--disable-pip-version-check"]).args(WHEELS);
    match execute(&mut install) {
        Outcome::Ok => match fs::write(&complete, wheels) {
            Ok(()) => Outcome::Ok,
            Err(error) => Outcome::Failed(error.to_string()),
        },
        other => other,
    }
}
