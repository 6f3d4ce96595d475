// SPDX-License-Identifier: MIT OR Apache-2.0
//! Strings and `wstring`s of a length stated before.

use super::length_end;
use crate::cdr::{BoundFill, Carver, EncodeError, EncodeFault, Fill, Piece, WString, WriteError, WriteFault};

/// The memory for a string.
#[derive(Debug)]
pub struct Text<'a> {
    /// Without the zero byte at its end.
    place: &'a mut [u8],
    bound: usize,
    set: bool,
}

impl Text<'_> {
    /// Writes it.
    ///
    /// # Errors
    /// [`WriteFault::Length`] if its number of bytes is not the stated one, [`EncodeFault::Bound`] if it has more
    /// characters than the definition allows.
    #[inline]
    pub fn set(&mut self, text: &str) -> Result<(), WriteError> {
        if text.len() != self.place.len() {
            let (len, stated) = (text.len(), self.place.len());
            return Err(WriteError::new(WriteFault::Length { len, stated }));
        }
        check_bound(text, self.bound)?;
        self.place.copy_from_slice(text.as_bytes());
        self.set = true;
        Ok(())
    }
}

macro_rules! piece {
    ($text:ident) => {
        impl Piece<String> for $text<'_> {
            #[inline]
            fn check(&self) -> Result<(), WriteError> {
                match self.set || self.place.is_empty() {
                    true => Ok(()),
                    false => Err(WriteError::new(WriteFault::Unset)),
                }
            }

            fn default_rest(&mut self, text: Option<&String>) {
                if !self.set
                    && let Some(text) = text
                {
                    // A text of another length stays unset, which `check` reports.
                    let _ = self.set(text);
                }
            }
        }
    };
}
piece!(Text);
piece!(WText);

/// The memory for a `wstring`.
#[derive(Debug)]
pub struct WText<'a> {
    place: &'a mut [u8],
    bound: usize,
    set: bool,
}

impl WText<'_> {
    /// Writes it.
    ///
    /// # Errors
    /// [`WriteFault::Length`] if its number of UTF-16 units is not the stated one, [`EncodeFault::Bound`] if it has
    /// more characters than the definition allows.
    pub fn set(&mut self, text: &str) -> Result<(), WriteError> {
        let (len, stated) = (text.encode_utf16().count(), self.place.len() / 4);
        if len != stated {
            return Err(WriteError::new(WriteFault::Length { len, stated }));
        }
        check_bound(text, self.bound)?;
        for (place, unit) in self.place.chunks_exact_mut(4).zip(text.encode_utf16()) {
            place.copy_from_slice(&u32::from(unit).to_le_bytes());
        }
        self.set = true;
        Ok(())
    }
}

/// A text has no fewer bytes than characters, so those of a short text need not be counted.
fn check_bound(text: &str, bound: usize) -> Result<(), WriteError> {
    if text.len() > bound && text.chars().count() > bound {
        let len = text.chars().count();
        return Err(WriteError::new(WriteFault::Encode(EncodeFault::Bound { len, bound })));
    }
    Ok(())
}

impl Fill for String {
    type Sizes<'s> = usize;
    type Writer<'a, 's> = Text<'a>;
    crate::one_by_one!();

    crate::sizes_of_values! {
        fn sizes_from<'s>(value: Option<&Self>, source: &mut impl crate::cdr::SizeSource<'s>) -> usize {
            source.len(value.map(String::len))
        }
    }

    #[inline]
    fn sized_end(len: usize, at: usize) -> usize {
        length_end(at).saturating_add(len).saturating_add(1)
    }

    #[inline]
    fn carve<'a, 's: 's>(len: usize, carver: &mut Carver<'a>) -> Result<Text<'a>, EncodeError> {
        Self::carve_bounded(len, usize::MAX, carver)
    }
}

impl BoundFill for String {
    #[inline]
    fn carve_bounded<'a, 's: 's>(
        len: usize,
        bound: usize,
        carver: &mut Carver<'a>,
    ) -> Result<Text<'a>, EncodeError> {
        carver.length(len.saturating_add(1), usize::MAX)?;
        let place = carver.take(1, len)?;
        carver.take(1, 1)?.fill(0);
        Ok(Text { place, bound, set: false })
    }
}

impl Fill for WString {
    type Sizes<'s> = usize;
    type Writer<'a, 's> = WText<'a>;
    crate::one_by_one!();

    crate::sizes_of_values! {
        fn sizes_from<'s>(value: Option<&String>, source: &mut impl crate::cdr::SizeSource<'s>) -> usize {
            source.len(value.map(|value| value.encode_utf16().count()))
        }
    }

    fn sized_end(len: usize, at: usize) -> usize {
        length_end(at).saturating_add(len.saturating_mul(4))
    }

    fn carve<'a, 's: 's>(len: usize, carver: &mut Carver<'a>) -> Result<WText<'a>, EncodeError> {
        Self::carve_bounded(len, usize::MAX, carver)
    }
}

impl BoundFill for WString {
    fn carve_bounded<'a, 's: 's>(
        len: usize,
        bound: usize,
        carver: &mut Carver<'a>,
    ) -> Result<WText<'a>, EncodeError> {
        carver.length(len, usize::MAX)?;
        Ok(WText { place: carver.take(1, len.saturating_mul(4))?, bound, set: false })
    }
}
