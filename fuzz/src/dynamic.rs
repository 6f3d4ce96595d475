// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages of types that are known at run time only.

use std::sync::{Arc, LazyLock};

use tautline_msgs::cdr;
use tautline_schema::{DynamicMessage, Endian, Layout, MessageError, Packages, Schema, Size};

use crate::allocations::Limit;
use crate::entry::entries;
use crate::input::Input;

/// The schemas of the bundled types, in the order of `entries`.
static SCHEMAS: LazyLock<Vec<Arc<Schema>>> = LazyLock::new(|| {
    let mut packages = Packages::new();
    packages.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/../msgs/ros/definitions"));
    let schema =
        |name: &str| packages.schema(&name.parse().expect("a type's name")).expect("a valid definition");
    entries().iter().map(|entry| entry.name).map(schema).map(Arc::new).collect()
});

/// The schema of a bundled type.
pub fn bundled(input: &Input<'_>) -> &'static Arc<Schema> {
    input.choose(&SCHEMAS)
}

/// A list of messages of one byte each: 24 bytes for its fields, 32 for the one field, and the list grows to twice its
/// length. The fixed part is for a message's own fields, and for what errors say.
const DYNAMIC: Limit = Limit { multiple: 64, fixed: 8192 };

/// Decodes a message of a bundled type, or, if bit 1 of the flags is set, of the type that the input defines up to its
/// first zero.
pub fn dynamic(input: &[u8]) {
    let Some(input) = Input::new(input) else { return };
    if input.flag(1) {
        let mut parts = input.rest.splitn(2, |&byte| byte == 0);
        let text = String::from_utf8_lossy(parts.next().unwrap_or_default());
        let name = "demo_msgs/msg/Demo".parse().expect("a type's name");
        let Ok(schema) = Schema::from_text(&name, &text) else { return };
        decode(&Arc::new(schema), parts.next().unwrap_or_default(), input.flag(0), text.len());
        return;
    }
    let bytes = decode(bundled(&input), input.rest, input.flag(0), 0);
    let endian = if input.flag(0) { cdr::Endian::Big } else { cdr::Endian::Little };
    assert_eq!((input.choose(entries()).decode)(input.rest, endian), bytes);
}

/// The body of what is decoded.
fn decode(schema: &Arc<Schema>, body: &[u8], big: bool, definition: usize) -> Option<Vec<u8>> {
    let endian = if big { Endian::Big } else { Endian::Little };
    let decoded = DYNAMIC.check(body.len() + definition, || DynamicMessage::from_body(schema, body, endian));
    match decoded {
        Ok(message) => {
            let bytes = message.to_body();
            let again = DynamicMessage::from_body(schema, &bytes, Endian::Little).expect("just encoded");
            assert_eq!((again.to_body(), again.trailing_bytes()), (bytes.clone(), 0));
            if let Size::Fixed(len) = Layout::of(schema).size {
                assert_eq!(bytes.len(), len);
            }
            let json = DynamicMessage::from_json(schema, &message.to_json()).expect("our own JSON");
            // A NaN has one spelling.
            assert!(json.to_body() == bytes || message.to_json().contains("NaN"));
            Some(bytes)
        }
        Err(MessageError::Decode { type_name, offset, .. }) => {
            assert_eq!(type_name, schema.name().as_str());
            assert!(offset <= body.len().next_multiple_of(8), "{offset}");
            None
        }
        Err(other) => panic!("{other}"),
    }
}
