// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::cdr::DecodeFault;

/// The alignment of bodies in memory, in bytes: that of the largest number.
pub const BODY_ALIGN: usize = 8;

/// Bytes that should be a little-endian body, not validated yet, at an address where a body can be read in
/// place.
#[derive(Clone, Copy, Debug)]
pub struct Body<'a> {
    memory: &'a [u8],
    len: usize,
}

impl<'a> Body<'a> {
    /// The body in the first `len` bytes of `memory`. What follows belongs to the padding of plain types, whose size in
    /// memory is a multiple of their alignment.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Errors
    /// [`DecodeFault::Alignment`] if `memory` does not start at a multiple of [`BODY_ALIGN`], [`DecodeFault::End`] if it
    /// is shorter than `len`.
    pub fn new(memory: &'a [u8], len: usize) -> Result<Self, DecodeFault> {
        if memory.as_ptr().align_offset(BODY_ALIGN) != 0 {
            return Err(DecodeFault::Alignment { align: BODY_ALIGN });
        }
        if len > memory.len() {
            return Err(DecodeFault::End { needed: len, left: memory.len() });
        }
        Ok(Self { memory, len })
    }

    /// The body itself.
    pub fn bytes(self) -> &'a [u8] {
        self.memory.get(..self.len).unwrap_or_default()
    }

    /// The body and what follows it.
    pub fn memory(self) -> &'a [u8] {
        self.memory
    }
}
