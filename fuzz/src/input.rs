// SPDX-License-Identifier: MIT OR Apache-2.0
//! What an input starts with.

/// An input: a number of 16 bits, one of 8 bits, the rest.
pub struct Input<'a> {
    /// Chooses the type.
    pub choice: u16,
    /// Chooses what is done.
    pub flags: u8,
    pub rest: &'a [u8],
}

impl<'a> Input<'a> {
    /// `None` if there is not even the start.
    pub fn new(input: &'a [u8]) -> Option<Self> {
        let (&[low, high, flags], rest) = input.split_first_chunk()?;
        Some(Self { choice: u16::from_le_bytes([low, high]), flags, rest })
    }

    /// One of `all`.
    pub fn choose<'t, T>(&self, all: &'t [T]) -> &'t T {
        &all[usize::from(self.choice) % all.len()]
    }

    pub fn flag(&self, bit: u8) -> bool {
        self.flags & 1 << bit != 0
    }
}
