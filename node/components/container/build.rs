// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lets the program find the libraries that it shares with components: in its own folder, where cargo puts them, and in the
//! toolchain with which it was built.

use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let folder = Command::new(rustc).args(["--print", "target-libdir"]).output().map(|output| output.stdout);
    let folder = String::from_utf8(folder.unwrap_or_default()).unwrap_or_default();
    for path in ["$ORIGIN", "$ORIGIN/deps", "$ORIGIN/..", folder.trim()] {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{path}");
    }
}
