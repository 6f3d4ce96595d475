// SPDX-License-Identifier: MIT OR Apache-2.0
//! `rmw_tautline`: the middleware interface of ROS 2's client libraries, on Tautline's transport. rclcpp, rclpy and other clients
//! of rcl run on it unchanged.
//!
//! Each function checks its arguments, executes, and returns a code; no panic leaves it (`error`).
//!
//! | module | one idea |
//! |---|---|
//! | `context` | a participant of a domain; `options`: its options |
//! | `node`, `publisher`, `subscription`, `service`, `client` | ROS's entities; `topic`: arguments for creating topic endpoints |
//! | `wait` | wait sets; `signal`: what they sleep on; `end`: receiving endpoints, woken by publishers; `guard`: flags that any thread sets |
//! | `event` | QoS events, received by the `helper`, a thread in place of the sampler; `callback`: callbacks of ROS; `on_new`: those for messages; `notifier`: the thread that calls them for other contexts |
//! | `graph` | the graph |
//! | `types` | types of messages and services; `support`: their type supports; `cdr`: callbacks of these; `layout`: types with equal layout in memory and CDR; `serialization`: messages as bytes; `lend`: those in shared memory; `qos`: profiles |
//! | `distro` | what differs between distributions of ROS 2 |
//! | `handle` | ROS's handles, and the other arguments: `exported!` has rmw's functions check them |
//! | `unsupported` | unsupported functions |
//! | `log` | forwards Tautline's log to ROS's |

mod bindings;
mod callback;
mod cdr;
mod client;
mod context;
mod distro;
mod end;
mod error;
mod event;
mod graph;
mod guard;
mod handle;
mod helper;
mod job;
mod layout;
mod lend;
mod log;
mod node;
mod notifier;
mod on_new;
mod options;
mod publisher;
mod qos;
mod serialization;
mod service;
mod signal;
mod subscription;
mod support;
mod system;
#[cfg(test)]
mod tests;
mod thread;
mod topic;
mod types;
mod unsupported;
mod wait;

use bindings::*;
use handle::{IDENTIFIER, check_identifier, exported};
use std::ffi::c_char;

/// The name for RMW_IMPLEMENTATION.
#[unsafe(no_mangle)]
pub extern "C" fn rmw_get_implementation_identifier() -> *const c_char {
    IDENTIFIER.as_ptr()
}

/// The encoding of serialized messages.
#[unsafe(no_mangle)]
pub extern "C" fn rmw_get_serialization_format() -> *const c_char {
    c"cdr".as_ptr()
}

/// Messages have both sequence numbers.
#[unsafe(no_mangle)]
pub extern "C" fn rmw_feature_supported(feature: rmw_feature_t) -> bool {
    matches!(
        feature,
        RMW_FEATURE_MESSAGE_INFO_PUBLICATION_SEQUENCE_NUMBER
            | RMW_FEATURE_MESSAGE_INFO_RECEPTION_SEQUENCE_NUMBER
    )
}

exported! {
    fn rmw_compare_gids_equal(
        one: *const rmw_gid_t => given "the gid",
        other: *const rmw_gid_t => given "the other gid",
        is_equal: *mut bool => place "the answer",
    ) {
        check_identifier(one.implementation_identifier, "the gid")?;
        check_identifier(other.implementation_identifier, "the other gid")?;
        *is_equal = one.data == other.data;
        Ok(())
    }
}
