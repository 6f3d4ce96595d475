// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::cdr::{DecodeError, DecodeFault, Endian};

/// A body, which may hold anything, and how far it is read.
#[derive(Debug)]
pub struct Reader<'a> {
    body: &'a [u8],
    at: usize,
    endian: Endian,
    /// How many bytes may follow the last field.
    slack: usize,
}

/// What may follow a message at its end, and as much again for every empty sequence of 8-byte numbers and every
/// `wstring`: when ROS 2 computes the length of a message, it aligns elements that are not there and counts a zero at
/// the end of a `wstring`, and then sends that many bytes.
const SLACK: usize = 8;

impl<'a> Reader<'a> {
    /// Starts at the start of `body`.
    #[must_use]
    pub fn new(body: &'a [u8], endian: Endian) -> Self {
        Self { body, at: 0, endian, slack: SLACK }
    }

    /// How many bytes are read.
    #[must_use]
    pub fn position(&self) -> usize {
        self.at
    }

    /// How many bytes are left.
    #[must_use]
    pub fn left(&self) -> usize {
        self.body.len().saturating_sub(self.at)
    }

    /// The order of the bytes of numbers.
    #[must_use]
    pub fn endian(&self) -> Endian {
        self.endian
    }

    /// Skips to the next multiple of `align`, a power of two, and takes `len` bytes.
    ///
    /// # Errors
    ///
    /// [`DecodeFault::End`] if the body ends before.
    #[inline]
    pub fn take(&mut self, align: usize, len: usize) -> Result<&'a [u8], DecodeError> {
        self.at = self.at.next_multiple_of(align);
        let end = self.at.saturating_add(len);
        match self.body.get(self.at..end) {
            Some(bytes) => {
                self.at = end;
                Ok(bytes)
            }
            None => Err(self.fault(DecodeFault::End { needed: len, left: self.left() })),
        }
    }

    /// Takes a length.
    ///
    /// # Errors
    ///
    /// As [`take`](Self::take).
    #[inline]
    pub fn length(&mut self) -> Result<usize, DecodeError> {
        let bytes = self.take(4, 4)?;
        let bytes = bytes.try_into().unwrap_or_default();
        let len = match self.endian {
            Endian::Little => u32::from_le_bytes(bytes),
            Endian::Big => u32::from_be_bytes(bytes),
        };
        Ok(len as usize)
    }

    /// Checks that what is left can be `count` elements of at least `min_size` bytes each.
    ///
    /// # Errors
    ///
    /// [`DecodeFault::End`] otherwise.
    #[inline]
    pub fn expect(&self, count: usize, min_size: usize) -> Result<(), DecodeError> {
        let (needed, left) = (count.saturating_mul(min_size), self.left());
        if needed > left { Err(self.fault(DecodeFault::End { needed, left })) } else { Ok(()) }
    }

    /// Checks that no more bytes are left than ROS 2 may append.
    ///
    /// # Errors
    ///
    /// [`DecodeFault::Trailing`] otherwise.
    pub fn finish(&self) -> Result<(), DecodeError> {
        let (len, most) = (self.left(), self.slack);
        if len > most { Err(self.fault(DecodeFault::Trailing { len, most })) } else { Ok(()) }
    }

    /// ROS 2 may append more: see `SLACK`.
    #[inline]
    pub(crate) fn add_slack(&mut self) {
        self.slack += SLACK;
    }

    /// An error here.
    #[cold]
    pub(crate) fn fault(&self, fault: DecodeFault) -> DecodeError {
        DecodeError::new(self.at, fault)
    }
}
