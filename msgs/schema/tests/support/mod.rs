// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the tests share: where ROS 2 is, if it is there.

use std::path::{Path, PathBuf};

use tautline_schema::Packages;

/// The Python environment with ROS 2 that `cargo xtask ros` makes; prints why a test is skipped without it.
pub fn ros() -> Option<PathBuf> {
    // Packages that use this lie at different depths.
    let targets = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().map(|folder| folder.join("target"));
    let target = std::env::var_os("CARGO_TARGET_DIR").map(PathBuf::from);
    let mut venvs = target.into_iter().chain(targets).map(|target| target.join("ros/venv"));
    let found = venvs.find(|venv| venv.join("wheels.txt").is_file());
    if found.is_none() {
        assert!(std::env::var_os("CI").is_none(), "CI needs a ROS 2: run `cargo xtask ros`");
        eprintln!("skipped: no ROS 2 under target/ros: run `cargo xtask ros`");
    }
    found
}

/// The definitions of that ROS 2.
pub fn packages(venv: &Path) -> Packages {
    let mut packages = Packages::new();
    packages.add_folder(venv);
    packages
}
