// SPDX-License-Identifier: MIT OR Apache-2.0
//! Errors of rcl.

use r2r_rcl::{RCL_RET_OK, rcl_ret_t, rcutils_get_error_string, rcutils_reset_error};
use std::ffi::CStr;

/// rcl or the RMW failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{what} failed in ROS 2: {reason} (code {code})")]
pub struct RclError {
    /// The step.
    pub what: &'static str,
    /// rcl's error code.
    pub code: i32,
    /// rcl's error text.
    pub reason: String,
}

/// Maps a return code to an error with rcl's message of this thread, and resets that message.
pub(crate) fn check(what: &'static str, code: rcl_ret_t) -> Result<(), RclError> {
    if code == RCL_RET_OK as rcl_ret_t { Ok(()) } else { Err(last_error(what, code)) }
}

/// Whether something was taken: the code `nothing` means that the queue was empty.
pub(crate) fn taken(what: &'static str, code: rcl_ret_t, nothing: u32) -> Result<bool, RclError> {
    if code == nothing as rcl_ret_t {
        // SAFETY: resets rcl's message of this thread only.
        unsafe { rcutils_reset_error() };
        return Ok(false);
    }
    check(what, code).map(|()| true)
}

fn last_error(what: &'static str, code: rcl_ret_t) -> RclError {
    // SAFETY: both access state of this thread only; the text is an array in the returned value, which rcutils
    // terminates with NUL.
    let text = unsafe {
        let error = rcutils_get_error_string();
        let text = CStr::from_ptr(error.str_.as_ptr()).to_string_lossy().into_owned();
        rcutils_reset_error();
        text
    };
    // Drops rcl's source location, as in "..., at ./src/rcl/context.c:42".
    let reason = text.split(", at ").next().unwrap_or_default().trim().to_owned();
    RclError { what, code, reason }
}
