// SPDX-License-Identifier: MIT OR Apache-2.0

use core::fmt::{self, Write};

/// The text of a `wstring` in a body: UTF-16, each unit in four bytes. Valid.
#[derive(Clone, Copy)]
pub struct WStr<'a> {
    units: &'a [u32],
}

impl<'a> WStr<'a> {
    /// Checks the units. `None` if they are not valid UTF-16.
    pub(crate) fn new(units: &'a [u32]) -> Option<Self> {
        let text = Self { units };
        let all_units = units.iter().all(|&unit| u16::try_from(unit).is_ok());
        (all_units && text.decode().all(|char| char.is_ok())).then_some(text)
    }

    fn decode(self) -> impl Iterator<Item = Result<char, core::char::DecodeUtf16Error>> {
        // Each unit fitted into 16 bits when it was checked.
        char::decode_utf16(self.units.iter().map(|&unit| unit as u16))
    }

    /// The characters.
    pub fn chars(self) -> impl Iterator<Item = char> {
        self.decode().map(|char| char.unwrap_or(char::REPLACEMENT_CHARACTER))
    }

    /// The number of UTF-16 units.
    pub fn len(self) -> usize {
        self.units.len()
    }

    /// Whether there are none.
    pub fn is_empty(self) -> bool {
        self.units.is_empty()
    }
}

impl fmt::Display for WStr<'_> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.chars().try_for_each(|char| formatter.write_char(char))
    }
}

impl fmt::Debug for WStr<'_> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_char('"')?;
        self.chars().flat_map(char::escape_debug).try_for_each(|char| formatter.write_char(char))?;
        formatter.write_char('"')
    }
}

impl PartialEq<str> for WStr<'_> {
    fn eq(&self, other: &str) -> bool {
        self.chars().eq(other.chars())
    }
}

impl PartialEq<&str> for WStr<'_> {
    fn eq(&self, other: &&str) -> bool {
        *self == **other
    }
}
