// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes messages to any serde format.

use serde::ser::{Serialize, SerializeMap, Serializer};

use crate::{DynamicMessage, List, Schema, Value};

/// An object of the fields, in their order.
impl Serialize for DynamicMessage {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        Fields { schema: &self.schema, node: 0, values: &self.fields }.serialize(serializer)
    }
}

struct Fields<'a> {
    schema: &'a Schema,
    node: usize,
    values: &'a [Value],
}

impl Serialize for Fields<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let node = self.schema.node(self.node);
        if node.definition.is_empty() {
            return serializer.serialize_map(Some(0))?.end();
        }
        let mut map = serializer.serialize_map(Some(self.values.len()))?;
        for ((field, nested), value) in node.definition.fields.iter().zip(&node.nested).zip(self.values) {
            map.serialize_entry(
                &field.name,
                &Item { schema: self.schema, nested: nested.unwrap_or(0), value },
            )?;
        }
        map.end()
    }
}

struct Item<'a> {
    schema: &'a Schema,
    nested: usize,
    value: &'a Value,
}

impl Serialize for Item<'_> {
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
            Value::F32(value) => Float(*value).serialize(serializer),
            Value::F64(value) => Float(*value).serialize(serializer),
            Value::String(value) => serializer.serialize_str(value),
            Value::Struct(values) => Fields { schema, node, values }.serialize(serializer),
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
                List::F32(items) => serializer.collect_seq(items.iter().map(|item| Float(*item))),
                List::F64(items) => serializer.collect_seq(items.iter().map(|item| Float(*item))),
                List::String(items) => items.serialize(serializer),
                List::Struct(items) => {
                    serializer.collect_seq(items.iter().map(|values| Fields { schema, node, values }))
                }
            },
        }
    }
}

/// A float that may be one of those JSON has no number for.
struct Float<T>(T);

impl<T: Serialize + Copy + Into<f64>> Serialize for Float<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let value: f64 = self.0.into();
        match value {
            _ if value.is_nan() => serializer.serialize_str("NaN"),
            f64::INFINITY => serializer.serialize_str("Infinity"),
            f64::NEG_INFINITY => serializer.serialize_str("-Infinity"),
            _ => self.0.serialize(serializer),
        }
    }
}
