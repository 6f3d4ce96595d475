// SPDX-License-Identifier: MIT OR Apache-2.0
//! Compiles the LTTng provider if the feature `lttng` is enabled.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    #[cfg(feature = "lttng")]
    lttng();
}

#[cfg(feature = "lttng")]
fn lttng() {
    for file in ["lttng/provider.c", "lttng/ros2.h", "lttng/r2r.h"] {
        println!("cargo::rerun-if-changed={file}");
    }
    let mut build = cc::Build::new();
    build.file("lttng/provider.c").include("lttng").warnings(true).extra_warnings(true);
    // Most often the headers are missing; anything else is in the compiler's words.
    if let Err(error) = build.try_compile("taut_lttng") {
        println!(
            "cargo::error=the feature `lttng` needs LTTng-UST: sudo apt install lttng-tools liblttng-ust-dev babeltrace2"
        );
        println!("cargo::error=the compiler says: {}", error.to_string().replace('\n', " "));
        return;
    }
    for library in ["lttng-ust", "lttng-ust-common"] {
        println!("cargo::rustc-link-lib={library}");
    }
}
