// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the bridge finds the libraries of a ROS 2 that is not sourced: `cargo xtask ros` sets the variable.

fn main() {
    println!("cargo:rerun-if-env-changed=TAUT_ROS_RPATH");
    if let Ok(lib) = std::env::var("TAUT_ROS_RPATH") {
        // RPATH, for RUNPATH does not reach what the libraries themselves need.
        println!("cargo:rustc-link-arg=-Wl,--disable-new-dtags,-rpath,{lib}");
    }
}
