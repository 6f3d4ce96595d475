// SPDX-License-Identifier: MIT OR Apache-2.0
//! Peers that are not ours, for tests: hiroz in this process, zenoh-ros2-sdk in a Python of its own.

use std::path::PathBuf;
use std::process::Command;

/// The Python with zenoh-ros2-sdk, which `cargo xtask peers` makes. Prints why there is none; in CI there must be one.
pub fn python() -> Option<PathBuf> {
    let made = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../target/peers/venv");
    let venv = std::env::var_os("TAUT_PEERS_VENV").map_or_else(|| PathBuf::from(made), PathBuf::from);
    let python = venv.join("bin/python");
    let works = Command::new(&python).args(["-c", "import zenoh_ros2_sdk, xxhash"]).output();
    if works.is_ok_and(|output| output.status.success()) {
        return Some(python);
    }
    assert!(
        std::env::var_os("CI").is_none(),
        "no zenoh-ros2-sdk in {}: run `cargo xtask peers`",
        venv.display()
    );
    println!("skipped: no zenoh-ros2-sdk in {}; `cargo xtask peers` makes it", venv.display());
    None
}

/// A script beside this crate.
pub fn script(name: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/python")).join(name)
}
