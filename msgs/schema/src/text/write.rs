// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes messages to any serde format.

use std::io;

use serde::ser::{Serialize, SerializeMap, Serializer};
use serde_json::ser::Formatter;

use crate::{DynamicMessage, List, Schema, Value};

/// An object of the fields, in their order.
impl Serialize for DynamicMessage {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        Fields::<false> { schema: &self.schema, node: 0, values: &self.fields }.serialize(serializer)
    }
}

/// A message as JSON whose NaN and infinities are numbers.
pub fn extended_json(message: &DynamicMessage) -> String {
    let fields = Fields::<true> { schema: &message.schema, node: 0, values: &message.fields };
    let mut text = Vec::new();
    let written = fields.serialize(&mut serde_json::Serializer::with_formatter(&mut text, BareNumbers));
    // All keys are strings, and a vector takes every text.
    written.ok().and_then(|()| String::from_utf8(text).ok()).unwrap_or_default()
}

/// Writes bytes as they are. Only [`Float`] serializes bytes; lists of `uint8` are sequences.
struct BareNumbers;

impl Formatter for BareNumbers {
    fn write_byte_array<W: ?Sized + io::Write>(&mut self, writer: &mut W, value: &[u8]) -> io::Result<()> {
        writer.write_all(value)
    }
}

/// With `EXTENDED`, for [`extended_json`].
struct Fields<'a, const EXTENDED: bool> {
    schema: &'a Schema,
    node: usize,
    values: &'a [Value],
}

impl<const EXTENDED: bool> Serialize for Fields<'_, EXTENDED> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let node = self.schema.node(self.node);
        if node.definition.is_empty() {
            return serializer.serialize_map(Some(0))?.end();
        }
        let mut map = serializer.serialize_map(Some(self.values.len()))?;
        for ((field, nested), value) in node.definition.fields.iter().zip(&node.nested).zip(self.values) {
            map.serialize_entry(
                &field.name,
                &Item::<EXTENDED> { schema: self.schema, nested: nested.unwrap_or(0), value },
            )?;
        }
        map.end()
    }
}

struct Item<'a, const EXTENDED: bool> {
    schema: &'a Schema,
    nested: usize,
    value: &'a Value,
}

impl<const EXTENDED: bool> Serialize for Item<'_, EXTENDED> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self { schema, nested: node, value } = *self;
        match value {
            Value::Bool(value) => serializer.serialize_bool(*value),
            Value::I8(value) => serializer.serialize_i8(*value),
            Value::U8(value) => serializer.serialize_u8(*value),
            Value::I16(value) => serializer.serialize_i16(*value),
            Value::U16(value) => serializer.serialize_u16(*value),
            Value::I32(value) => serializer.serialize_i32(*value),
            Value::U32(value) => serializer.serialize_u32(*value),
            Value::I64(value) => serializer.serialize_i64(*value),
            Value::U64(value) => serializer.serialize_u64(*value),
            Value::F32(value) => Float::<_, EXTENDED>(*value).serialize(serializer),
            Value::F64(value) => Float::<_, EXTENDED>(*value).serialize(serializer),
            Value::String(value) => serializer.serialize_str(value),
            Value::Struct(values) => Fields::<EXTENDED> { schema, node, values }.serialize(serializer),
            Value::List(list) => match list {
                List::Bool(items) => items.serialize(serializer),
                List::I8(items) => items.serialize(serializer),
                List::U8(items) => items.serialize(serializer),
                List::I16(items) => items.serialize(serializer),
                List::U16(items) => items.serialize(serializer),
                List::I32(items) => items.serialize(serializer),
                List::U32(items) => items.serialize(serializer),
                List::I64(items) => items.serialize(serializer),
                List::U64(items) => items.serialize(serializer),
                List::F32(items) => {
                    serializer.collect_seq(items.iter().map(|item| Float::<_, EXTENDED>(*item)))
                }
                List::F64(items) => {
                    serializer.collect_seq(items.iter().map(|item| Float::<_, EXTENDED>(*item)))
                }
                List::String(items) => items.serialize(serializer),
                List::Struct(items) => serializer
                    .collect_seq(items.iter().map(|values| Fields::<EXTENDED> { schema, node, values })),
            },
        }
    }
}

/// A float that may be one of those JSON has no number for.
struct Float<T, const EXTENDED: bool>(T);

impl<T: Serialize + Copy + Into<f64>, const EXTENDED: bool> Serialize for Float<T, EXTENDED> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let value: f64 = self.0.into();
        let name = match value {
            _ if value.is_nan() => "NaN",
            f64::INFINITY => "Infinity",
            f64::NEG_INFINITY => "-Infinity",
            _ => return self.0.serialize(serializer),
        };
        if EXTENDED { serializer.serialize_bytes(name.as_bytes()) } else { serializer.serialize_str(name) }
    }
}
