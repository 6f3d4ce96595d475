// SPDX-License-Identifier: MIT OR Apache-2.0
//! What rcl says when it refuses.

use r2r_rcl::{RCL_RET_OK, rcl_ret_t, rcutils_get_error_string, rcutils_reset_error};
use std::ffi::CStr;

/// rcl, or the RMW below it, refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{what} failed in ROS 2: {reason} (code {code})")]
pub struct RclError {
    /// Which step.
    pub what: &'static str,
    /// rcl's number for it.
    pub code: i32,
    /// rcl's word for it.
    pub reason: String,
}

/// The error of a call, and rcl's message of this thread, which is reset.
pub(crate) fn check(what: &'static str, code: rcl_ret_t) -> Result<(), RclError> {
    if code == RCL_RET_OK as rcl_ret_t { Ok(()) } else { Err(last_error(what, code)) }
}

/// Whether something was taken: `code` is `nothing` if there is nothing to take.
pub(crate) fn taken(what: &'static str, code: rcl_ret_t, nothing: u32) -> Result<bool, RclError> {
    if code == nothing as rcl_ret_t {
        // SAFETY: forgets what rcl said about that, of this thread.
        unsafe { rcutils_reset_error() };
        return Ok(false);
    }
    check(what, code).map(|()| true)
}

fn last_error(what: &'static str, code: rcl_ret_t) -> RclError {
    // SAFETY: both look at state of this thread only; the text is an array within the value that is returned, and ends
    // with a zero, as rcutils writes it.
    let text = unsafe {
        let error = rcutils_get_error_string();
        let text = CStr::from_ptr(error.str_.as_ptr()).to_string_lossy().into_owned();
        rcutils_reset_error();
        text
    };
    // "..., at ./src/rcl/context.c:42" is of no use to whoever reads it.
    let reason = text.split(", at ").next().unwrap_or_default().trim().to_owned();
    RclError { what, code, reason }
}
