// SPDX-License-Identifier: MIT OR Apache-2.0
//! ROS 2's headers, read by bindgen. Enums are numbers, because C may pass any value.
#![allow(
    missing_docs,
    dead_code,
    unused_imports,
    non_camel_case_types,
    non_snake_case,
    non_upper_case_globals
)]
#![allow(unsafe_op_in_unsafe_fn, clippy::all, clippy::undocumented_unsafe_blocks)]

include!(concat!(env!("OUT_DIR"), "/bindings.rs"));

pub const RET_OK: rmw_ret_t = RMW_RET_OK as rmw_ret_t;
pub const RET_ERROR: rmw_ret_t = RMW_RET_ERROR as rmw_ret_t;
pub const RET_TIMEOUT: rmw_ret_t = RMW_RET_TIMEOUT as rmw_ret_t;
pub const RET_UNSUPPORTED: rmw_ret_t = RMW_RET_UNSUPPORTED as rmw_ret_t;
pub const RET_BAD_ALLOC: rmw_ret_t = RMW_RET_BAD_ALLOC as rmw_ret_t;
pub const RET_INVALID_ARGUMENT: rmw_ret_t = RMW_RET_INVALID_ARGUMENT as rmw_ret_t;
pub const RET_INCORRECT_RMW_IMPLEMENTATION: rmw_ret_t = RMW_RET_INCORRECT_RMW_IMPLEMENTATION as rmw_ret_t;
pub const RET_NODE_NAME_NON_EXISTENT: rmw_ret_t = RMW_RET_NODE_NAME_NON_EXISTENT as rmw_ret_t;
