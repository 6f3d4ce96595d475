// SPDX-License-Identifier: MIT OR Apache-2.0
//! Binds the headers of a ROS 2: for rmw_tautline and for the bench that measures it.

use std::env;
use std::path::{Path, PathBuf};

/// What an RMW calls of librmw, librcutils and the type supports' dispatch.
const FUNCTIONS: &str = "rmw_(allocate|free|get_default_.*_options|.*_allocate|.*_free|.*_zero_initialized_.*|(discovery|enclave)_options_(copy|fini)\
    |security_options_(copy|fini)|names_and_types_.*|topic_endpoint_info_.*|validate_.*|.*_validation_result_string)\
    |rcutils_(get_default_allocator|error_is_set|get_error_string|reset_error|set_error_state|string_array_(init|fini)|strdup|uint8_array_resize|log)\
    |get_(message|service)_typesupport_handle";

const TYPES: &str = "rmw_.*|rcutils_.*|rosidl_(message|service)_type_support_t|rosidl_runtime_c__.*|rosidl_type_hash_t\
    |rosidl_typesupport_introspection_c__(Message|Service)Members";

const HEADERS: &str = "
#include <rcutils/logging.h>
#include <rcutils/strdup.h>
#include <rmw/allocators.h>
#include <rmw/event.h>
#include <rmw/events_statuses/events_statuses.h>
#include <rmw/features.h>
#include <rmw/get_node_info_and_types.h>
#include <rmw/get_service_names_and_types.h>
#include <rmw/get_topic_names_and_types.h>
#include <rmw/get_topic_endpoint_info.h>
#include <rmw/names_and_types.h>
#include <rmw/rmw.h>
#if __has_include(<rmw/get_service_endpoint_info.h>)
#include <rmw/get_service_endpoint_info.h>
#endif
#include <rmw/validate_full_topic_name.h>
#include <rmw/validate_namespace.h>
#include <rmw/validate_node_name.h>
#include <rosidl_runtime_c/message_type_support_struct.h>
#include <rosidl_runtime_c/service_type_support_struct.h>
#include <rosidl_typesupport_introspection_c/message_introspection.h>
#include <rosidl_typesupport_introspection_c/service_introspection.h>
";

/// A ROS 2.
#[allow(dead_code, reason = "the bench reads the prefixes alone")]
pub struct Ros {
    /// The folders of its headers.
    pub includes: Vec<PathBuf>,
    pub prefixes: Vec<PathBuf>,
    /// The text of `bindings.rs`.
    pub bindings: String,
}

/// Writes `bindings.rs` into cargo's output folder, for the ROS 2 in `AMENT_PREFIX_PATH`.
pub fn bind() -> Ros {
    for name in ["AMENT_PREFIX_PATH", "TAUT_ROS_RPATH", "LIBCLANG_PATH"] {
        println!("cargo:rerun-if-env-changed={name}");
    }
    let prefixes = env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    let prefixes: Vec<PathBuf> = env::split_paths(&prefixes).collect();
    assert!(
        prefixes.iter().any(|prefix| prefix.join("include/rmw").is_dir()),
        "no ROS 2 is sourced (AMENT_PREFIX_PATH): source one, or build with `cargo xtask rmw`"
    );
    let includes: Vec<PathBuf> =
        prefixes.iter().flat_map(|prefix| includes(&prefix.join("include"))).collect();
    let bindings = write(&includes);
    Ros { includes, prefixes, bindings }
}

/// Has the linker find librmw and librcutils in these prefixes, and programs at run time.
pub fn link(prefixes: &[PathBuf]) {
    for library in prefixes.iter().map(|prefix| prefix.join("lib")).filter(|library| library.is_dir()) {
        println!("cargo:rustc-link-search=native={}", library.display());
    }
    if let Ok(lib) = env::var("TAUT_ROS_RPATH") {
        println!("cargo:rustc-link-arg=-Wl,--disable-new-dtags,-rpath,{lib}");
    }
}

/// `include` and each package's folder in it: `include/rmw/rmw/rmw.h`, and headers of packages of the older layout.
fn includes(include: &Path) -> Vec<PathBuf> {
    let packages = std::fs::read_dir(include).into_iter().flatten().flatten().map(|entry| entry.path());
    packages.filter(|path| path.is_dir()).chain([include.to_owned()]).collect()
}

fn write(includes: &[PathBuf]) -> String {
    let bindings = bindgen::Builder::default()
        .header_contents("rmw_tautline.h", HEADERS)
        .clang_args(includes.iter().map(|path| format!("-I{}", path.display())))
        .allowlist_function(FUNCTIONS)
        .allowlist_type(TYPES)
        .allowlist_var("RMW_.*|RCUTILS_.*")
        .prepend_enum_name(false)
        .derive_default(true)
        .layout_tests(false)
        .generate_comments(false)
        .generate()
        .expect("the headers of ROS 2 are read");
    let file = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it")).join("bindings.rs");
    let text = bindings.to_string();
    std::fs::write(file, &text).expect("the bindings are written");
    text
}
