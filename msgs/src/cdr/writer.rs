// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::cdr::{EncodeError, EncodeFault};

/// A little-endian body while it is written. Never writes past the end of its buffer.
#[derive(Debug)]
pub struct Writer<'a> {
    out: &'a mut [u8],
    at: usize,
}

impl<'a> Writer<'a> {
    /// Starts a body at the start of `out`.
    pub fn new(out: &'a mut [u8]) -> Self {
        Self { out, at: 0 }
    }

    /// How many bytes are written.
    pub fn position(&self) -> usize {
        self.at
    }

    /// Appends zeros up to the next multiple of `align`, a power of two, then `bytes`.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Linear in the number of bytes.
    ///
    /// # Errors
    /// [`EncodeFault::Room`] if the buffer ends before; nothing is written then.
    #[inline(always)] // 5 % of a message of short strings
    pub fn put(&mut self, align: usize, bytes: &[u8]) -> Result<(), EncodeError> {
        let start = self.at.next_multiple_of(align);
        let end = start + bytes.len();
        let Some(place) = self.out.get_mut(self.at..end) else {
            return Err(EncodeError::new(EncodeFault::Room { needed: end, len: self.out.len() }));
        };
        let (padding, place) = place.split_at_mut(start - self.at);
        clear(padding);
        place.copy_from_slice(bytes);
        self.at = end;
        Ok(())
    }

    /// Appends a string: its length, its UTF-8 and a zero byte.
    ///
    /// # Real-time
    /// As [`put`](Self::put).
    ///
    /// # Errors
    /// As [`length`](Self::length).
    #[inline(always)] // 5 % of a message of short strings
    pub(crate) fn string(&mut self, text: &str) -> Result<(), EncodeError> {
        let start = self.at.next_multiple_of(4);
        let len = text.len() + 1;
        let end = start + 4 + len;
        let (Ok(number), Some(place)) = (u32::try_from(len), self.out.get_mut(self.at..end)) else {
            // Finds out which of the two failed, as for any other length and bytes.
            self.length(len)?;
            return self.put(1, text.as_bytes()).and_then(|()| self.put(1, &[0]));
        };
        let (padding, place) = place.split_at_mut(start - self.at);
        clear(padding);
        if let Some((length, place)) = place.split_first_chunk_mut::<4>()
            && let Some((zero, place)) = place.split_last_mut()
        {
            *length = number.to_le_bytes();
            place.copy_from_slice(text.as_bytes());
            *zero = 0;
        }
        self.at = end;
        Ok(())
    }

    /// Appends a length as `uint32`.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Errors
    /// [`EncodeFault::Length`] if it does not fit, else as [`put`](Self::put).
    #[inline]
    pub fn length(&mut self, len: usize) -> Result<(), EncodeError> {
        match u32::try_from(len) {
            Ok(len) => self.put(4, &len.to_le_bytes()),
            Err(_) => Err(EncodeError::new(EncodeFault::Length { len })),
        }
    }
}

/// Mostly there is no padding, and the call of `memset` that a loop becomes would cost more than the rest.
#[inline]
fn clear(padding: &mut [u8]) {
    if !padding.is_empty() {
        padding.fill(0);
    }
}
