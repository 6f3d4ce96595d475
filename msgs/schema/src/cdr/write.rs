// SPDX-License-Identifier: MIT OR Apache-2.0
//! Encodes values, which are known to fit their schema, into bytes.

use crate::{Base, FieldType, List, Schema, Shape, Value};

/// A little-endian body while it is written. Padding is zero.
pub struct Writer<'a> {
    schema: &'a Schema,
    out: Vec<u8>,
    /// Where the body starts in `out`.
    start: usize,
}

impl<'a> Writer<'a> {
    /// Appends to `out`.
    pub fn new(schema: &'a Schema, out: Vec<u8>) -> Self {
        Self { schema, start: out.len(), out }
    }

    pub fn message(mut self, fields: &[Value]) -> Vec<u8> {
        self.structure(0, fields);
        self.out
    }

    fn structure(&mut self, index: usize, values: &[Value]) {
        let schema = self.schema;
        let node = schema.node(index);
        for ((field, nested), value) in node.definition.fields.iter().zip(&node.nested).zip(values) {
            self.field(&field.ty, *nested, value);
        }
    }

    fn field(&mut self, ty: &FieldType, nested: Option<usize>, value: &Value) {
        let wide = matches!(ty.base, Base::WString { .. });
        match value {
            Value::Bool(value) => self.number([u8::from(*value)]),
            Value::I8(value) => self.number(value.to_le_bytes()),
            Value::U8(value) => self.number(value.to_le_bytes()),
            Value::I16(value) => self.number(value.to_le_bytes()),
            Value::U16(value) => self.number(value.to_le_bytes()),
            Value::I32(value) => self.number(value.to_le_bytes()),
            Value::U32(value) => self.number(value.to_le_bytes()),
            Value::I64(value) => self.number(value.to_le_bytes()),
            Value::U64(value) => self.number(value.to_le_bytes()),
            Value::F32(value) => self.number(value.to_le_bytes()),
            Value::F64(value) => self.number(value.to_le_bytes()),
            Value::String(text) => self.string(text, wide),
            Value::Struct(fields) => self.structure(nested.unwrap_or(0), fields),
            Value::List(list) => {
                if !matches!(ty.shape, Shape::Array(_)) {
                    self.length(list.len());
                }
                self.list(list, nested, wide);
            }
        }
    }

    fn list(&mut self, list: &List, nested: Option<usize>, wide: bool) {
        match list {
            List::Bool(items) => items.iter().for_each(|&item| self.out.push(item.into())),
            List::I8(items) => items.iter().for_each(|item| self.out.extend(item.to_le_bytes())),
            List::U8(items) => self.out.extend_from_slice(items),
            List::I16(items) => self.numbers(items.iter().map(|item| item.to_le_bytes())),
            List::U16(items) => self.numbers(items.iter().map(|item| item.to_le_bytes())),
            List::I32(items) => self.numbers(items.iter().map(|item| item.to_le_bytes())),
            List::U32(items) => self.numbers(items.iter().map(|item| item.to_le_bytes())),
            List::I64(items) => self.numbers(items.iter().map(|item| item.to_le_bytes())),
            List::U64(items) => self.numbers(items.iter().map(|item| item.to_le_bytes())),
            List::F32(items) => self.numbers(items.iter().map(|item| item.to_le_bytes())),
            List::F64(items) => self.numbers(items.iter().map(|item| item.to_le_bytes())),
            List::String(items) => items.iter().for_each(|item| self.string(item, wide)),
            List::Struct(items) => items.iter().for_each(|item| self.structure(nested.unwrap_or(0), item)),
        }
    }

    fn numbers<const N: usize>(&mut self, items: impl ExactSizeIterator<Item = [u8; N]>) {
        if items.len() > 0 {
            self.align(N);
        }
        self.out.reserve(items.len() * N);
        items.for_each(|item| self.out.extend_from_slice(&item));
    }

    fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        self.align(N);
        self.out.extend_from_slice(&bytes);
    }

    fn string(&mut self, text: &str, wide: bool) {
        if wide {
            self.length(text.encode_utf16().count());
            text.encode_utf16().for_each(|unit| self.out.extend(u32::from(unit).to_le_bytes()));
        } else {
            self.length(text.len() + 1);
            self.out.extend_from_slice(text.as_bytes());
            self.out.push(0);
        }
    }

    /// Lengths were checked to fit when the value was made.
    fn length(&mut self, len: usize) {
        self.number(u32::try_from(len).unwrap_or(u32::MAX).to_le_bytes());
    }

    fn align(&mut self, size: usize) {
        let len = (self.out.len() - self.start).next_multiple_of(size);
        self.out.resize(self.start + len, 0);
    }
}
