// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bundled types as values; owned messages, views, and messages written in place.

use std::fmt::{self, Debug, Write};

use tautline_msgs::cdr::{Endian, Fill, Reader, View};
use tautline_msgs::{Body, Message};

use crate::allocations::Limit;
use crate::input::Input;
use crate::memory::{Memory, encode};

/// What can be done with a type.
pub struct Entry {
    pub name: &'static str,
    /// The body of what is decoded.
    pub decode: fn(&[u8], Endian) -> Option<Vec<u8>>,
    pub view: fn(&[u8]),
    pub fill: fn(&Input<'_>),
}

include!(concat!(env!("OUT_DIR"), "/entries.rs"));

/// Every message of the bundled packages, the parts of services and actions included.
pub fn entries() -> &'static [Entry] {
    ENTRIES
}

/// Their names: an input chooses by the place in this list.
pub fn type_names() -> Vec<&'static str> {
    entries().iter().map(|entry| entry.name).collect()
}

impl Entry {
    const fn of<T: Message + View + Fill + Default>() -> Self
    where
        for<'a> <T as View>::Ref<'a>: Debug,
    {
        Self {
            name: T::TYPE_NAME,
            decode: decode::<T>,
            view: read_in_place::<T>,
            fill: crate::fill::write::<T>,
        }
    }
}

/// A list grows to twice its length; the smallest of its elements against what they are in memory are strings and lists:
/// four bytes of a length for the 24 of a `String`. What cannot be read takes nothing.
const OWNED: Limit = Limit { multiple: 12, fixed: 4 * 24 };

/// Decodes a message of a bundled type.
pub fn owned(input: &[u8]) {
    let Some(input) = Input::new(input) else { return };
    let endian = if input.flag(0) { Endian::Big } else { Endian::Little };
    (input.choose(entries()).decode)(input.rest, endian);
}

fn decode<T: Message>(body: &[u8], endian: Endian) -> Option<Vec<u8>> {
    match OWNED.check(body.len(), || T::decode(body, endian)) {
        Ok(message) => {
            let bytes = encode(&message);
            let again = T::decode(&bytes, Endian::Little).expect("what was encoded is a message");
            assert_eq!(encode(&again), bytes);
            Some(bytes)
        }
        Err(error) => {
            assert_eq!(error.type_name, T::TYPE_NAME);
            assert!(error.offset <= body.len().next_multiple_of(8), "{error}");
            None
        }
    }
}

/// Reads a body in place.
pub fn view(input: &[u8]) {
    let Some(input) = Input::new(input) else { return };
    (input.choose(entries()).view)(input.rest);
}

fn read_in_place<T: Message + View>(body: &[u8])
where
    for<'a> <T as View>::Ref<'a>: Debug,
{
    // A struct's padding may follow; of other types nothing beyond the body is touched.
    let room = if T::FIXED_LEN.is_some() { body.len().next_multiple_of(8) } else { body.len() };
    let memory = Memory::with(body, room, 0xee);
    let claimed = Body::new(memory.bytes(), body.len()).expect("aligned and as long as it says");
    let viewed = Limit::NONE.check(0, || <T as Message>::view(claimed).map(|_| ()));
    match (viewed, T::decode(body, Endian::Little)) {
        (Ok(()), Ok(message)) => {
            let mut reader = Reader::new(claimed.bytes(), Endian::Little);
            let view = T::view_value(&mut reader).expect("read a moment ago");
            // Debug goes through every getter.
            Limit::NONE.check(0, || write!(Nowhere, "{view:?}")).expect("nothing fails");
            assert_eq!(encode(&T::own(view)), encode(&message));
        }
        (Err(viewed), Err(decoded)) => assert_eq!(viewed, decoded),
        (Ok(()), Err(error)) => panic!("a view of what is not decoded: {error}"),
        (Err(error), Ok(_)) => panic!("no view of what is decoded: {error}"),
    }
}

/// Writes a message of a bundled type in place.
pub fn fill(input: &[u8]) {
    let Some(input) = Input::new(input) else { return };
    (input.choose(entries()).fill)(&input);
}

struct Nowhere;

impl Write for Nowhere {
    fn write_str(&mut self, _: &str) -> fmt::Result {
        Ok(())
    }
}
