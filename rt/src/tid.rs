// SPDX-License-Identifier: MIT OR Apache-2.0
//! The kernel's ids of threads.

use rustix::thread::Pid;

use crate::RtError;

/// The kernel's id of the current thread.
pub fn current_tid() -> u32 {
    rustix::thread::gettid().as_raw_nonzero().get().cast_unsigned()
}

/// Only a positive id names a thread: 0 would be the caller, and above `i32::MAX` none.
pub(crate) fn pid(tid: u32) -> Result<Pid, RtError> {
    i32::try_from(tid).ok().and_then(Pid::from_raw).ok_or(RtError::NoSuchThread { tid })
}
