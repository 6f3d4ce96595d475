// SPDX-License-Identifier: MIT OR Apache-2.0
//! A type's Fast CDR callbacks, between C or C++ structs and CDR bodies. `cdr.cpp` is the other half.

use crate::error::{Error, Result};
use std::ffi::{CStr, c_char, c_void};

unsafe extern "C" {
    fn taut_cdr_longest(callbacks: *const c_void, bounds: *mut u8) -> usize;
    fn taut_cdr_estimate(
        callbacks: *const c_void,
        message: *const c_void,
        estimate: *mut usize,
        reason: *mut c_char,
        reason_bytes: usize,
    ) -> bool;
    fn taut_cdr_write(
        callbacks: *const c_void,
        message: *const c_void,
        to: *mut u8,
        capacity: usize,
        written: *mut usize,
        reason: *mut c_char,
        reason_bytes: usize,
    ) -> bool;
    fn taut_cdr_read(
        callbacks: *const c_void,
        from: *const u8,
        size: usize,
        is_little: bool,
        message: *mut c_void,
        reason: *mut c_char,
        reason_bytes: usize,
    ) -> bool;
}

/// `ROSIDL_TYPESUPPORT_FASTRTPS_PLAIN_TYPE` and `_BOUNDED_TYPE`.
const PLAIN: u8 = 3;
const BOUNDED: u8 = 1;

const REASON_BYTES: usize = 256;

/// The length of a type's CDR bodies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Length {
    /// All bodies have this length, and equal the first bytes of the struct in memory.
    Plain(usize),
    AtMost(usize),
    Any,
}

/// The callbacks of one type.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct Callbacks(*const c_void);

// SAFETY: constants of a library that stays loaded while a type of it is in use; the functions are stateless.
unsafe impl Send for Callbacks {}
// SAFETY: as above.
unsafe impl Sync for Callbacks {}

impl Callbacks {
    /// # Safety
    /// `data` is of a type support for Fast CDR that outlives this.
    pub(crate) unsafe fn new(data: *const c_void) -> Self {
        Callbacks(data)
    }

    pub(crate) fn length(self) -> Length {
        let mut bounds = 0;
        // SAFETY: valid callbacks.
        let longest = unsafe { taut_cdr_longest(self.0, &mut bounds) };
        match bounds {
            PLAIN => Length::Plain(longest),
            BOUNDED => Length::AtMost(longest),
            _ => Length::Any,
        }
    }

    /// Upper bound of the length of a message's body: Fast CDR also counts padding that it does not write.
    ///
    /// # Safety
    /// `message` is a message of this type.
    pub(crate) unsafe fn estimate(self, message: *const c_void) -> Result<usize> {
        let (mut estimate, mut reason) = (0, [0; REASON_BYTES]);
        // SAFETY: the caller's contract; the pointers are valid.
        let is_done =
            unsafe { taut_cdr_estimate(self.0, message, &mut estimate, reason.as_mut_ptr(), REASON_BYTES) };
        if is_done { Ok(estimate) } else { Err(refused("measured", &reason)) }
    }

    /// Writes a message's body to `to`, whose bytes may be uninitialised. Returns its length.
    ///
    /// # Safety
    /// `message` is a message of this type.
    pub(crate) unsafe fn write(self, message: *const c_void, to: &mut [u8]) -> Result<usize> {
        let (mut written, mut reason) = (0, [0; REASON_BYTES]);
        let (bytes, capacity) = (to.as_mut_ptr(), to.len());
        // SAFETY: the caller's contract; Fast CDR writes nothing beyond `capacity`.
        let is_done = unsafe {
            taut_cdr_write(self.0, message, bytes, capacity, &mut written, reason.as_mut_ptr(), REASON_BYTES)
        };
        if is_done { Ok(written.min(capacity)) } else { Err(refused("written", &reason)) }
    }

    /// Reads a body into a message. After an error the message is still valid, with unspecified content.
    ///
    /// # Safety
    /// `message` is a message of this type, initialised.
    pub(crate) unsafe fn read(self, from: &[u8], is_little: bool, message: *mut c_void) -> Result {
        let mut reason = [0; REASON_BYTES];
        let (bytes, size) = (from.as_ptr(), from.len());
        // SAFETY: the caller's contract; Fast CDR reads nothing beyond `size`.
        let is_done = unsafe {
            taut_cdr_read(self.0, bytes, size, is_little, message, reason.as_mut_ptr(), REASON_BYTES)
        };
        if is_done { Ok(()) } else { Err(refused("read", &reason)) }
    }
}

fn refused(what: &str, reason: &[c_char; REASON_BYTES]) -> Error {
    // SAFETY: zero-initialised; the shim keeps the last zero.
    let reason = unsafe { CStr::from_ptr(reason.as_ptr()) };
    Error::other(format!("the message cannot be {what}: {}", reason.to_string_lossy()))
}
