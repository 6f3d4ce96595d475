// SPDX-License-Identifier: MIT OR Apache-2.0
//! Binds the headers of the ROS 2 in `AMENT_PREFIX_PATH`, and builds the shim over Fast CDR with it.

#[path = "bind.rs"]
mod bind;
#[path = "src/distro/interface.rs"]
mod interface;

fn main() {
    println!("cargo:rerun-if-changed=src/cdr.cpp");
    println!("cargo:rerun-if-env-changed=ROS_DISTRO");
    println!("cargo:rustc-env=ROS_DISTRO={}", std::env::var("ROS_DISTRO").unwrap_or_default());
    let bind::Ros { includes, prefixes, bindings } = bind::bind();
    let interface = interface::of(|function| bindings.contains(&format!("fn {function}(")));
    println!("cargo:rustc-env=RMW_INTERFACE={interface}");
    println!("cargo:rustc-check-cfg=cfg(humble)");
    if interface == "humble" {
        println!("cargo:rustc-cfg=humble");
    }
    cc::Build::new().cpp(true).std("c++17").includes(&includes).file("src/cdr.cpp").compile("taut_cdr");
    bind::link(&prefixes);
    for library in ["rmw", "rcutils", "rosidl_runtime_c", "fastcdr"] {
        println!("cargo:rustc-link-lib=dylib={library}");
    }
    // By this name whoever loads two of them knows that they are one.
    println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,librmw_tautline.so");
}
