// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writing in place, with lengths from anywhere.

use std::cell::Cell;

use bumpalo::Bump;
use tautline_msgs::Message;
use tautline_msgs::cdr::{self, Endian, Fill, Piece, SizeSource};

use crate::input::Input;
use crate::memory::{Memory, encode};

/// The most elements with sizes of their own.
const MOST: usize = 64;

/// Lengths from an input: those of a value, or others.
struct Lengths<'a, 's> {
    /// Each says how the next length is wrong.
    wrong: &'a [u8],
    /// Whether all are those of the value.
    right: bool,
    arena: &'s Bump,
}

impl Lengths<'_, '_> {
    fn any(&mut self, actual: usize) -> usize {
        let Some((&wrong, rest)) = self.wrong.split_first() else { return actual };
        self.wrong = rest;
        let len = match wrong {
            0..64 => return actual,
            64..128 => usize::from(wrong - 64),
            128..192 => 1 << (wrong - 128),
            192..224 => usize::MAX >> (wrong - 192),
            224..240 => actual + usize::from(wrong - 223),
            240.. => actual.saturating_sub(usize::from(wrong - 239)),
        };
        self.right &= len == actual;
        len
    }
}

impl<'s> SizeSource<'s> for Lengths<'_, 's> {
    fn len(&mut self, actual: Option<usize>) -> usize {
        self.any(actual.unwrap_or_default())
    }

    /// The list is made, so it cannot be of any length.
    fn count(&mut self, actual: Option<usize>) -> usize {
        let actual = actual.unwrap_or_default();
        let len = self.any(actual);
        self.right &= len <= actual.max(MOST);
        len.min(actual.max(MOST))
    }

    fn keep<T: Copy + 's>(&mut self, list: Vec<T>) -> &'s [T] {
        self.arena.alloc_slice_copy(&list)
    }
}

/// The flags: bits 0 and 1 choose the fields that are set, bits 2 and 3 the length of the memory. Then the number of
/// lengths that are wrong, these, and the body of a value.
pub(crate) fn write<T: Message + Fill + Default>(input: &Input<'_>) {
    let Some((&count, rest)) = input.rest.split_first() else { return };
    let (wrong, body) = rest.split_at(usize::from(count).min(rest.len()));
    let value = T::decode(body, Endian::Little).unwrap_or_default();
    let arena = Bump::new();
    let mut lengths = Lengths { wrong, right: true, arena: &arena };
    let sizes = T::sizes_from(Some(&value), &mut lengths);
    let len = cdr::sized_len::<T>(sizes);
    if lengths.right {
        assert_eq!(len, value.cdr_len());
    }

    let room = match input.flags >> 2 & 3 {
        0 => len,
        1 => len.saturating_add(8),
        2 => len.saturating_sub(1),
        _ => wrong.iter().map(|&byte| usize::from(byte)).sum(),
    };
    // More takes longer, and shows nothing more.
    let mut memory = Memory::new(room.min(1 << 11), 0xaa);
    let called = Cell::new(false);
    let written = cdr::fill::<T>(sizes, memory.bytes_mut(), |writer| {
        called.set(true);
        match input.flags & 3 {
            0 => {}
            1 => writer.default_rest(None),
            _ => writer.default_rest(Some(&value)),
        }
        Ok(())
    });
    let bytes = memory.bytes();
    // The writer exists exactly if there is room for it.
    assert!(!called.get() || len <= bytes.len(), "{len} bytes in {}", bytes.len());
    if let Ok(written) = written {
        assert_eq!(written, len);
        assert!(bytes[len..].iter().all(|&byte| byte == 0xaa), "written behind the end");
        if input.flags & 3 != 0 {
            let message = T::decode(&bytes[..len], Endian::Little).expect("a message was written");
            assert_eq!(encode(&message), &bytes[..len]);
        }
    }
    if lengths.right && len <= bytes.len() && input.flags & 3 > 1 {
        assert_eq!(written, Ok(len));
        assert_eq!(&bytes[..len], encode(&value));
    }
}
