// SPDX-License-Identifier: MIT OR Apache-2.0
//! The compile-time proof that C layout is CDR layout. Called by the code that the derive writes; no public API.
//!
//! Why one comparison per field is a proof: a field's own layout is proven from offset 0. At an offset that is a
//! multiple of its C alignment (its largest primitive), all its primitives keep their distances in CDR too. So a struct
//! agrees as soon as each field's first primitive lies where CDR places it.

use core::any::type_name;

use crate::{Invalid, Plain};

/// A field as the derive sees it.
pub struct Field {
    /// Its name.
    pub name: &'static str,
    /// Its type as written.
    pub type_name: &'static str,
    /// Where C places it, in bytes.
    pub offset: usize,
    /// `size_of` its type.
    pub size: usize,
    /// [`Plain::CDR_SIZE`] of its type.
    pub cdr_size: usize,
    /// [`Plain::FIRST_ALIGN`] of its type.
    pub first_align: usize,
}

/// Fails the build unless `field`, which follows `previous`, lies in C where it lies in CDR.
pub const fn check(struct_name: &str, previous: &Field, field: &Field) {
    let cdr_end = previous.offset + previous.cdr_size;
    let cdr_offset = next_multiple(cdr_end, field.first_align);
    if field.offset == cdr_offset {
        return;
    }
    let mut text = Text::new();
    text.push("in `").push(struct_name).push("`, field `").push(field.name).push(": ").push(field.type_name);
    text.push("` is at byte ")
        .number(field.offset)
        .push(" in C but at byte ")
        .number(cdr_offset)
        .push(" in CDR: ");
    let trailing = previous.size - previous.cdr_size;
    if trailing > 0 {
        // C pads the previous field at its end, CDR does not. A field in between would come after the padding in C.
        text.push("end the struct in field `").push(previous.name).push(": ").push(previous.type_name);
        text.push("` with `_pad: [u8; ").number(trailing).push("]`, or move `").push(previous.name);
        text.push("` to the end of `").push(struct_name).push("`");
    } else {
        // C aligns a nested struct to its largest field, CDR to its first.
        text.push("insert `_pad: [u8; ")
            .number(field.offset - cdr_offset)
            .push("]` before `")
            .push(field.name);
        text.push("`, or move `").push(field.name).push("` to the start of `").push(struct_name).push("`");
    }
    panic!("{}", text.as_str());
}

/// Fails the build: array elements end with `trailing` bytes of padding, which CDR does not have.
pub const fn array_error(trailing: usize) -> ! {
    let mut text = Text::new();
    text.push("the elements of this array are padded in C but not in CDR: end the element's struct with `_pad: [u8; ");
    text.number(trailing).push("]`, or order its fields so that its first is its most aligned");
    panic!("{}", text.as_str());
}

/// `value` rounded up to a multiple of `align`.
pub const fn next_multiple(value: usize, align: usize) -> usize {
    value.next_multiple_of(align)
}

/// Zeroes the bytes from `start` to before `end`, as far as there are any.
#[inline]
pub fn clear(memory: &mut [u8], start: usize, end: usize) {
    if let Some(padding) = memory.get_mut(start..end) {
        padding.fill(0);
    }
}

/// Zeroes the padding in the field of type `T` at `offset`.
#[inline]
pub fn clear_at<T: Plain>(memory: &mut [u8], offset: usize) {
    if T::CONTENT_SIZE != T::CDR_SIZE {
        T::clear_padding(memory.get_mut(offset..).unwrap_or_default());
    }
}

/// Validates the field of type `T` at `offset` in `bytes`.
#[inline]
pub fn validate_at<T: Plain>(bytes: &[u8], offset: usize) -> Result<(), Invalid> {
    if T::ALWAYS_VALID {
        return Ok(());
    }
    T::validate(bytes.get(offset..).unwrap_or_default()).map_err(|fault| fault.at(offset))
}

/// The first `N` bytes, which are to become a `T`.
#[inline]
pub fn read<const N: usize, T>(bytes: &[u8]) -> Result<[u8; N], Invalid> {
    bytes.first_chunk().copied().ok_or(Invalid::Length {
        type_name: type_name::<T>(),
        needed: N,
        len: bytes.len(),
    })
}

/// A compile-time string of bounded length: `const` code cannot `format!`.
struct Text {
    bytes: [u8; 1024],
    len: usize,
}

impl Text {
    const fn new() -> Self {
        Self { bytes: [0; 1024], len: 0 }
    }

    const fn push(&mut self, text: &str) -> &mut Self {
        let text = text.as_bytes();
        let mut i = 0;
        while i < text.len() && self.len < self.bytes.len() {
            self.bytes[self.len] = text[i];
            self.len += 1;
            i += 1;
        }
        self
    }

    const fn number(&mut self, value: usize) -> &mut Self {
        if value >= 10 {
            self.number(value / 10);
        }
        let digit = [b'0' + (value % 10) as u8];
        match core::str::from_utf8(&digit) {
            Ok(digit) => self.push(digit),
            Err(_) => self,
        }
    }

    const fn as_str(&self) -> &str {
        match core::str::from_utf8(self.bytes.split_at(self.len).0) {
            Ok(text) => text,
            Err(_) => "C layout differs from CDR layout",
        }
    }
}
