// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::cdr::{EncodeError, EncodeFault};

/// Divides the memory of a body, from its start, piece by piece.
#[derive(Debug)]
pub struct Carver<'a> {
    rest: &'a mut [u8],
    /// Where `rest` starts, in bytes from the start of the body.
    at: usize,
}

impl<'a> Carver<'a> {
    /// Starts with `memory`, which lies `at` bytes after the start of the body.
    pub fn new(memory: &'a mut [u8], at: usize) -> Self {
        Self { rest: memory, at }
    }

    /// How many bytes of the body are taken.
    pub fn position(&self) -> usize {
        self.at
    }

    /// Zeroes the padding up to the next multiple of `align`, a power of two, and takes `len` bytes.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Errors
    /// [`EncodeFault::Room`] if the memory ends before; nothing is taken then.
    #[inline]
    pub fn take(&mut self, align: usize, len: usize) -> Result<&'a mut [u8], EncodeError> {
        let padding = self.at.next_multiple_of(align) - self.at;
        let taken = padding.saturating_add(len);
        if taken > self.rest.len() {
            return Err(EncodeError::new(EncodeFault::Room {
                needed: self.at.saturating_add(taken),
                len: self.at + self.rest.len(),
            }));
        }
        let (taken_bytes, rest) = core::mem::take(&mut self.rest).split_at_mut(taken);
        self.rest = rest;
        self.at += taken;
        let (before, bytes) = taken_bytes.split_at_mut(padding);
        for byte in before {
            *byte = 0;
        }
        Ok(bytes)
    }

    /// Writes a length as `uint32`.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Errors
    /// [`EncodeFault::Bound`] if it is more than `bound`, [`EncodeFault::Length`] if it does not fit, else as
    /// [`take`](Self::take).
    #[inline]
    pub fn length(&mut self, len: usize, bound: usize) -> Result<(), EncodeError> {
        if len > bound {
            return Err(EncodeError::new(EncodeFault::Bound { len, bound }));
        }
        let Ok(number) = u32::try_from(len) else {
            return Err(EncodeError::new(EncodeFault::Length { len }));
        };
        self.take(4, 4)?.copy_from_slice(&number.to_le_bytes());
        Ok(())
    }
}
