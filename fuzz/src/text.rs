// SPDX-License-Identifier: MIT OR Apache-2.0
//! JSON and YAML.

use std::sync::Arc;

use tautline_schema::{DynamicMessage, MessageError, Schema};

use crate::allocations::Limit;
use crate::dynamic::bundled;
use crate::input::Input;

/// A parser's events and the fields of the message. The fixed part is for the message's defaults and what errors say.
const TEXT: Limit = Limit { multiple: 256, fixed: 64 << 10 };

type Read = fn(&Arc<Schema>, &str) -> Result<DynamicMessage, MessageError>;

/// Reads JSON as a bundled type.
pub fn json(input: &[u8]) {
    check(input, DynamicMessage::from_json, DynamicMessage::to_json);
}

/// Reads YAML as a bundled type.
pub fn yaml(input: &[u8]) {
    check(input, DynamicMessage::from_yaml, DynamicMessage::to_string);
}

fn check(input: &[u8], read: Read, write: fn(&DynamicMessage) -> String) {
    let Some(input) = Input::new(input) else { return };
    let text = String::from_utf8_lossy(input.rest);
    let schema = bundled(&input);
    let Ok(message) = TEXT.check(text.len(), || read(schema, &text)) else { return };
    let written = write(&message);
    let again = read(schema, &written).unwrap_or_else(|error| panic!("{error}: {written}"));
    assert_eq!(again.to_json(), message.to_json(), "{written}");
    let cdr = DynamicMessage::from_cdr(schema, &message.to_cdr()).expect("just encoded");
    assert_eq!(cdr.to_json(), message.to_json());
}
