// SPDX-License-Identifier: MIT OR Apache-2.0
//! A buffer of serialized bytes: 4 bytes of encapsulation, then CDR.

use super::error::{RclError, check};
use r2r_rcl::*;

/// Grows with its content, and is reused.
pub struct SerializedMessage {
    raw: rcl_serialized_message_t,
}

// SAFETY: it owns its memory, from the default allocator.
unsafe impl Send for SerializedMessage {}

impl SerializedMessage {
    /// An empty buffer.
    ///
    /// # Errors
    /// [`RclError`]: out of memory.
    pub fn new() -> Result<Self, RclError> {
        // SAFETY: rcutils' protocol: zero, initialise.
        unsafe {
            let mut raw = rcutils_get_zero_initialized_uint8_array();
            let allocator = rcutils_get_default_allocator();
            check("making a buffer", rcutils_uint8_array_init(&mut raw, 0, &allocator))?;
            Ok(SerializedMessage { raw })
        }
    }

    /// The bytes.
    pub fn bytes(&self) -> &[u8] {
        if self.raw.buffer.is_null() {
            return &[];
        }
        // SAFETY: rcutils and rmw keep `buffer_length` initialised bytes in the buffer.
        unsafe { std::slice::from_raw_parts(self.raw.buffer, self.raw.buffer_length) }
    }

    /// Stores `head` and `body`, one after the other.
    ///
    /// # Errors
    /// [`RclError`]: out of memory.
    pub fn assign(&mut self, head: &[u8], body: &[u8]) -> Result<(), RclError> {
        let len = head.len() + body.len();
        if self.raw.buffer_capacity < len {
            // SAFETY: the array is initialised.
            check("growing a buffer", unsafe { rcutils_uint8_array_resize(&mut self.raw, len) })?;
        }
        // SAFETY: the buffer has at least `len` bytes, and is exclusive.
        unsafe {
            std::ptr::copy_nonoverlapping(head.as_ptr(), self.raw.buffer, head.len());
            std::ptr::copy_nonoverlapping(body.as_ptr(), self.raw.buffer.add(head.len()), body.len());
        }
        self.raw.buffer_length = len;
        Ok(())
    }

    pub(crate) fn raw(&self) -> *const rcl_serialized_message_t {
        &self.raw
    }

    pub(crate) fn raw_mut(&mut self) -> *mut rcl_serialized_message_t {
        &mut self.raw
    }
}

impl Drop for SerializedMessage {
    fn drop(&mut self) {
        // SAFETY: initialised and exclusive.
        let _ = unsafe { rcutils_uint8_array_fini(&mut self.raw) };
    }
}
