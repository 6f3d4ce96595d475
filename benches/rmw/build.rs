// SPDX-License-Identifier: MIT OR Apache-2.0
//! Binds the headers of the ROS 2 in `AMENT_PREFIX_PATH`. The program loads an RMW by name; of librmw and librcutils it calls functions itself.

#[path = "../../rmw/bind.rs"]
mod bind;

fn main() {
    println!("cargo:rerun-if-changed=../../rmw/bind.rs");
    bind::link(&bind::bind().prefixes);
    for library in ["rmw", "rcutils"] {
        println!("cargo:rustc-link-arg-bins=-Wl,--no-as-needed,-l{library}");
    }
}
