// SPDX-License-Identifier: MIT OR Apache-2.0
//! The generated types as values: what to check with a message of each.

use std::sync::Arc;

use tautline_msgs::cdr::{self, DecodeFault, EncodeFault, Endian, Fill, Piece, Reader, View};
use tautline_msgs::serde::Serialize;
use tautline_msgs::serde::de::DeserializeOwned;
use tautline_msgs::{Body, Definition, Message, Plain};
use tautline_schema::{DynamicMessage, Schema, TypeName};

pub struct Entry {
    pub name: &'static str,
    pub hash: &'static str,
    pub definition: Option<&'static Definition>,
    /// The CDR of its default.
    pub default: fn() -> Vec<u8>,
    /// Decodes a message, holds it against the dynamic one in every form, and gives our bytes.
    pub check: fn(&[u8], &DynamicMessage) -> Vec<u8>,
}

include!(concat!(env!("OUT_DIR"), "/entries.rs"));

/// Every message that is generated, the parts of services and actions included.
pub fn entries() -> &'static [Entry] {
    ENTRIES
}

/// What generated types have in common.
trait Generated: Message + View + Fill + Serialize + DeserializeOwned + Default + PartialEq {}

impl<T: Message + View + Fill + Serialize + DeserializeOwned + Default + PartialEq> Generated for T {}

impl Entry {
    const fn of<T: Generated>() -> Self {
        Self {
            name: T::TYPE_NAME,
            hash: match T::TYPE_HASH {
                Some(hash) => hash,
                None => "",
            },
            definition: T::DEFINITION,
            default: || T::default().to_cdr().unwrap(),
            check: check::<T>,
        }
    }

    /// Of a plain type: its memory is checked as well.
    const fn plain<T: Plain + Generated>() -> Self {
        Self { check: check_plain::<T>, ..Self::of::<T>() }
    }

    pub fn type_name(&self) -> TypeName {
        self.name.parse().unwrap()
    }

    /// What `definitions` says it is.
    pub fn schema(&self) -> Arc<Schema> {
        let mut packages = tautline_schema::Packages::new();
        packages.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/definitions"));
        Arc::new(packages.schema(&self.type_name()).unwrap())
    }
}

fn check<T: Generated>(cdr: &[u8], dynamic: &DynamicMessage) -> Vec<u8> {
    let name = T::TYPE_NAME;
    let owned = T::from_cdr(cdr).unwrap_or_else(|error| panic!("{error}"));
    let bytes = owned.to_cdr().unwrap();
    assert_eq!(bytes, dynamic.to_cdr(), "{name}");
    let body = &bytes[4..];

    // Padding is written, nothing after the message is, and nothing before its end is enough.
    let len = owned.cdr_len();
    let mut buffer = vec![0xaa; len + 8];
    assert_eq!((owned.encode(&mut buffer), len), (Ok(len), body.len()), "{name}");
    assert_eq!((&buffer[..len], &buffer[len..]), (body, &[0xaa; 8][..]), "{name}");
    let error = owned.encode(&mut buffer[..len - 1]).unwrap_err();
    assert!(matches!(error.fault, EncodeFault::Room { .. }), "{error}");
    for end in (0..body.len()).step_by(1 + body.len() / 8).chain([body.len() - 1]) {
        let error = T::from_cdr(&bytes[..4 + end]).err().unwrap_or_else(|| panic!("{name}: {end} of {len}"));
        assert!(matches!(error.fault, DecodeFault::End { .. }), "{error}");
        assert!(error.type_name.contains('/') && error.offset <= end.next_multiple_of(8), "{error}");
    }

    in_place(&owned, body);

    let json = serde_json::to_string(&owned).unwrap();
    assert_eq!(json, dynamic.to_json(), "{name}");
    let again: T = serde_json::from_str(&json).unwrap_or_else(|error| panic!("{name}: {error}: {json}"));
    // As bytes, since a NaN does not equal itself.
    assert!(again.to_cdr().unwrap() == bytes || json.contains("\"NaN\""), "{name}: {json}");
    assert_eq!(again.cdr_len(), len, "{name}");
    bytes
}

/// Read in place it is the same message, written in place it has the same bytes, whatever the memory held before.
fn in_place<T: Generated>(owned: &T, body: &[u8]) {
    let name = T::TYPE_NAME;
    let mut words = vec![u64::MAX; body.len().div_ceil(8) + 1];
    // SAFETY: the bytes of numbers.
    let memory = unsafe { std::slice::from_raw_parts_mut(words.as_mut_ptr().cast::<u8>(), 8 * words.len()) };
    memory[..body.len()].copy_from_slice(body);
    memory[body.len()..].fill(0);
    let view = Body::new(memory, body.len()).unwrap();
    <T as Message>::view(view).unwrap_or_else(|error| panic!("{error}"));
    let again = T::own(T::view_value(&mut Reader::new(view.bytes(), Endian::Little)).unwrap());
    let mut bytes = vec![0; body.len()];
    assert_eq!(again.encode(&mut bytes), Ok(body.len()), "{name}");
    assert_eq!(bytes, body, "{name}");
    // A message that is cut off is not read, whatever lies after it.
    for end in (0..body.len()).step_by(1 + body.len() / 8) {
        let memory = Body::new(&memory[..end], end).unwrap();
        let error = <T as Message>::view(memory).err().unwrap_or_else(|| panic!("{name}: {end}"));
        assert!(
            matches!(error.fault, DecodeFault::End { .. }) && error.offset <= end.next_multiple_of(8),
            "{error}"
        );
    }
    memory.fill(0xaa);
    let sizes = T::sizes_of(owned);
    assert_eq!(cdr::sized_len::<T>(sizes), body.len(), "{name}");
    let written = cdr::fill::<T>(sizes, memory, |writer| {
        writer.default_rest(Some(owned));
        Ok(())
    });
    assert_eq!(written, Ok(body.len()), "{name}");
    assert_eq!(&memory[..body.len()], body, "{name}");
    assert_eq!(memory[body.len()..], vec![0xaa; memory.len() - body.len()], "{name}");
}

/// As [`check`]; and the value's memory, its padding cleared, is the body.
fn check_plain<T: Plain + Generated>(cdr: &[u8], dynamic: &DynamicMessage) -> Vec<u8> {
    let bytes = check::<T>(cdr, dynamic);
    let body = &bytes[4..];
    let value = T::from_cdr(&bytes).unwrap();
    assert_eq!((T::FIXED_LEN, T::CDR_SIZE), (Some(body.len()), body.len()), "{}", T::TYPE_NAME);
    let mut memory = vec![std::mem::MaybeUninit::<T>::uninit(); 1];
    // SAFETY: as many bytes as there are; that they have a value is seen to first.
    let raw = unsafe {
        let start = memory.as_mut_ptr().cast::<u8>();
        start.write_bytes(0xaa, size_of::<T>());
        std::slice::from_raw_parts_mut(start, size_of::<T>())
    };
    value.write_fields(raw);
    T::clear_padding(raw);
    assert_eq!(&raw[..T::CDR_SIZE], body, "{}", T::TYPE_NAME);
    bytes
}
