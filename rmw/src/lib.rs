// SPDX-License-Identifier: MIT OR Apache-2.0
//! `rmw_tautline`: what ROS 2's client libraries call their middleware, on Tautline's transport. rclcpp, rclpy and what else stands on
//! rcl run on it unchanged.
//!
//! Each function checks what it is given, does it, and answers a code; no panic leaves it ([`error`]).
//!
//! | module | one idea |
//! |---|---|
//! | `context` | a membership of a domain; `options`: what it is to be like |
//! | `node`, `publisher`, `subscription`, `service`, `client` | what ROS makes of each; `topic`: what ends of topics are asked for by |
//! | `wait` | wait sets, on `signal`: what they sleep on; `end`: whom publishers wake; `guard`: flags that any thread sets |
//! | `event` | QoS events, heard by the `helper`, a thread at the sampler's place; `callback`: who wants to be called |
//! | `graph` | who is there |
//! | `types` | type supports; `cdr`: their callbacks; `layout`: what lies in memory as it is sent; `serialization`: messages as bytes; `qos`: profiles |
//! | `handle` | what ROS holds of ours |
//! | `unsupported` | what there is not |
//! | `log` | ROS's log, for what Tautline says |

mod bindings;
mod callback;
mod cdr;
mod client;
mod context;
mod copy;
mod end;
mod error;
mod event;
mod graph;
mod guard;
mod handle;
mod helper;
mod job;
mod layout;
mod log;
mod node;
mod options;
mod publisher;
mod qos;
mod serialization;
mod service;
mod signal;
mod subscription;
mod system;
#[cfg(test)]
mod tests;
mod topic;
mod types;
mod unsupported;
mod wait;

use bindings::*;
use error::{Error, answer};
use handle::{IDENTIFIER, check_identifier, place};
use std::ffi::c_char;

/// The name by which RMW_IMPLEMENTATION chooses it.
#[unsafe(no_mangle)]
pub extern "C" fn rmw_get_implementation_identifier() -> *const c_char {
    IDENTIFIER.as_ptr()
}

/// How serialized messages are encoded.
#[unsafe(no_mangle)]
pub extern "C" fn rmw_get_serialization_format() -> *const c_char {
    c"cdr".as_ptr()
}

/// Messages have both of their numbers.
#[unsafe(no_mangle)]
pub extern "C" fn rmw_feature_supported(feature: rmw_feature_t) -> bool {
    matches!(
        feature,
        RMW_FEATURE_MESSAGE_INFO_PUBLICATION_SEQUENCE_NUMBER
            | RMW_FEATURE_MESSAGE_INFO_RECEPTION_SEQUENCE_NUMBER
    )
}

/// # Safety
/// As rmw says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_compare_gids_equal(
    one: *const rmw_gid_t,
    other: *const rmw_gid_t,
    is_equal: *mut bool,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's word.
        let (one, other, is_equal) = unsafe {
            let null = || Error::null("the gid");
            let (one, other) = (one.as_ref().ok_or_else(null)?, other.as_ref().ok_or_else(null)?);
            (one, other, place(is_equal, "the answer")?)
        };
        check_identifier(one.implementation_identifier, "the gid")?;
        check_identifier(other.implementation_identifier, "the other gid")?;
        *is_equal = one.data == other.data;
        Ok(())
    })
}
