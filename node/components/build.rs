// SPDX-License-Identifier: MIT OR Apache-2.0
//! The build environment that a component must have: compiler and target, for the stamp.

use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let version = Command::new(rustc).arg("--version").output().map(|output| output.stdout);
    let version = String::from_utf8(version.unwrap_or_default()).unwrap_or_default();
    println!("cargo::rustc-env=TAUTLINE_RUSTC={}", version.trim());
    println!("cargo::rustc-env=TAUTLINE_TARGET={}", std::env::var("TARGET").unwrap_or_default());
}
