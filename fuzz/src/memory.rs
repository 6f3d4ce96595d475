// SPDX-License-Identifier: MIT OR Apache-2.0
//! Memory of an exact length at an exact place, so that the address sanitizer sees the first byte beyond.

use std::alloc::{self, Layout};
use std::ptr::NonNull;

use tautline_msgs::Message;

use crate::allocations::Limit;

/// Bytes that start at a multiple of 8.
pub struct Memory {
    start: NonNull<u8>,
    len: usize,
}

impl Memory {
    /// `len` bytes of `fill`.
    pub fn new(len: usize, fill: u8) -> Self {
        let layout = Self::layout(len);
        // SAFETY: the layout's size is not 0.
        let start = NonNull::new(unsafe { alloc::alloc(layout) });
        let start = start.unwrap_or_else(|| alloc::handle_alloc_error(layout));
        // SAFETY: just allocated with so many bytes.
        unsafe { start.write_bytes(fill, len) };
        Self { start, len }
    }

    /// These bytes, then some of `fill` up to `len`.
    pub fn with(bytes: &[u8], len: usize, fill: u8) -> Self {
        let mut memory = Self::new(len.max(bytes.len()), fill);
        memory.bytes_mut()[..bytes.len()].copy_from_slice(bytes);
        memory
    }

    pub fn bytes(&self) -> &[u8] {
        // SAFETY: allocated and initialised by `new`; no exclusive reference while this one lives.
        unsafe { std::slice::from_raw_parts(self.start.as_ptr(), self.len) }
    }

    pub fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: allocated and initialised by `new`; no other reference while this one lives.
        unsafe { std::slice::from_raw_parts_mut(self.start.as_ptr(), self.len) }
    }

    fn layout(len: usize) -> Layout {
        Layout::from_size_align(len.max(1), 8).expect("fits into memory")
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        // SAFETY: allocated by `new` with this layout.
        unsafe { alloc::dealloc(self.start.as_ptr(), Self::layout(self.len)) }
    }
}

/// The body of a message, in memory that is not a byte longer.
pub fn encode<T: Message>(message: &T) -> Vec<u8> {
    let len = message.cdr_len();
    let mut memory = Memory::new(len, 0xaa);
    assert_eq!(Limit::NONE.check(0, || message.encode(memory.bytes_mut())), Ok(len));
    memory.bytes().to_vec()
}
