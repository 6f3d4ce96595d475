// SPDX-License-Identifier: MIT OR Apache-2.0
//! Decodes bytes, which may have any content, into values.

use std::mem::size_of;

use crate::{Base, DecodeFault, FieldType, List, Primitive, Schema, Shape, Value};

/// What is wrong and where. The path is built while the error is returned, so that success costs nothing.
pub struct Failure {
    pub path: String,
    pub offset: usize,
    pub fault: DecodeFault,
}

impl Failure {
    pub(super) fn in_field(mut self, name: &str) -> Self {
        let dot = if self.path.is_empty() || self.path.starts_with('[') { "" } else { "." };
        self.path = format!("{name}{dot}{}", self.path);
        self
    }

    pub(super) fn in_element(mut self, index: usize) -> Self {
        let dot = if self.path.is_empty() { "" } else { "." };
        self.path = format!("[{index}]{dot}{}", self.path);
        self
    }
}

pub(super) type Result<T> = std::result::Result<T, Failure>;

/// The number of bytes that may follow a message, and once more for every empty sequence of 8-byte numbers and every
/// `wstring`: when ROS 2 computes the length of a message, it aligns elements that are not there and counts a zero at
/// the end of a `wstring`, and then sends that many bytes.
const SLACK: usize = 8;

/// A body and how far it was read.
pub struct Reader<'a> {
    pub(super) schema: &'a Schema,
    body: &'a [u8],
    at: usize,
    big_endian: bool,
    /// How many bytes may follow the last field.
    slack: usize,
}

impl<'a> Reader<'a> {
    pub fn new(schema: &'a Schema, body: &'a [u8], big_endian: bool) -> Self {
        Self { schema, body, at: 0, big_endian, slack: SLACK }
    }

    /// The whole message, and how many bytes follow it.
    pub fn message(mut self) -> Result<(Vec<Value>, usize)> {
        let fields = self.structure(0)?;
        self.end().map(|trailing| (fields, trailing))
    }

    /// How many bytes are left after the last field.
    pub(super) fn end(&self) -> Result<usize> {
        match self.left() {
            len if len > self.slack => {
                let most = self.slack;
                Err(self.failure(DecodeFault::Trailing { len, most }))
            }
            len => Ok(len),
        }
    }

    fn structure(&mut self, index: usize) -> Result<Vec<Value>> {
        let schema = self.schema;
        let node = schema.node(index);
        if node.definition.is_empty() {
            // Writers leave this byte unset.
            self.take(1)?;
            return Ok(vec![Value::U8(0)]);
        }
        let mut fields = Vec::with_capacity(node.definition.fields.len());
        for (field, nested) in node.definition.fields.iter().zip(&node.nested) {
            fields.push(self.field(&field.ty, *nested).map_err(|failure| failure.in_field(&field.name))?);
        }
        Ok(fields)
    }

    fn field(&mut self, ty: &FieldType, nested: Option<usize>) -> Result<Value> {
        let len = match ty.shape {
            Shape::Single => return self.single(ty, nested),
            Shape::Array(len) => len as usize,
            Shape::Unbounded => self.length()?,
            Shape::Bounded(bound) => self.bounded_length(bound)?,
        };
        self.list(ty, nested, len).map(Value::List)
    }

    fn single(&mut self, ty: &FieldType, nested: Option<usize>) -> Result<Value> {
        match (&ty.base, nested) {
            (Base::Primitive(primitive), _) => {
                let list = self.primitives(*primitive, 1)?;
                // The list has one element.
                Ok(list.get(0).unwrap_or(Value::U8(0)))
            }
            (Base::WString { bound }, _) => Ok(Value::String(self.wide_string(*bound)?)),
            (Base::Nested(_), Some(nested)) => Ok(Value::Struct(self.structure(nested)?)),
            (Base::String { bound }, _) => Ok(Value::String(self.string(*bound)?)),
            // A schema knows all its types.
            (Base::Nested(_), None) => Ok(Value::Struct(vec![])),
        }
    }

    fn list(&mut self, ty: &FieldType, nested: Option<usize>, len: usize) -> Result<List> {
        match (&ty.base, nested) {
            (Base::Primitive(primitive), _) => self.primitives(*primitive, len),
            (Base::String { bound }, _) => {
                Ok(List::String(self.elements(len, 4, |reader| reader.string(*bound))?))
            }
            (Base::WString { bound }, _) => {
                Ok(List::String(self.elements(len, 4, |reader| reader.wide_string(*bound))?))
            }
            (Base::Nested(_), Some(nested)) => {
                let min_size = self.schema.node(nested).min_size;
                Ok(List::Struct(self.elements(len, min_size, |reader| reader.structure(nested))?))
            }
            (Base::Nested(_), None) => Ok(List::Struct(vec![])),
        }
    }

    /// Elements that need at least `min_size` bytes each. What is allocated at once is no more than the bytes left.
    fn elements<T>(
        &mut self,
        len: usize,
        min_size: usize,
        read: impl Fn(&mut Self) -> Result<T>,
    ) -> Result<Vec<T>> {
        let needed = len.saturating_mul(min_size);
        let left = self.left();
        if needed > left {
            return Err(self.failure(DecodeFault::End { needed, left }));
        }
        let mut elements = Vec::with_capacity(len.min(left / size_of::<T>()));
        for index in 0..len {
            elements.push(read(self).map_err(|failure| failure.in_element(index))?);
        }
        Ok(elements)
    }

    /// The bytes of numbers, of which each `bool` is 0 or 1.
    pub(super) fn primitive_bytes(&mut self, primitive: Primitive, len: usize) -> Result<&'a [u8]> {
        let size = primitive.size();
        if len > 0 {
            self.align(size);
        } else if size == 8 {
            self.slack += SLACK;
        }
        let start = self.at;
        let bytes = self.take(len.saturating_mul(size))?;
        if primitive == Primitive::Bool
            && let Some((index, &value)) = bytes.iter().enumerate().find(|(_, byte)| **byte > 1)
        {
            self.at = start + index;
            let failure = self.failure(DecodeFault::Bool { value });
            return Err(if len > 1 { failure.in_element(index) } else { failure });
        }
        Ok(bytes)
    }

    fn primitives(&mut self, primitive: Primitive, len: usize) -> Result<List> {
        let bytes = self.primitive_bytes(primitive, len)?;
        macro_rules! numbers {
            ($type:ty) => {{
                const SIZE: usize = size_of::<$type>();
                let numbers = bytes.chunks_exact(SIZE).map(|chunk| {
                    let chunk: [u8; SIZE] = chunk.try_into().unwrap_or_default();
                    if self.big_endian {
                        <$type>::from_be_bytes(chunk)
                    } else {
                        <$type>::from_le_bytes(chunk)
                    }
                });
                numbers.collect()
            }};
        }
        Ok(match primitive {
            Primitive::Bool => List::Bool(bytes.iter().map(|&byte| byte == 1).collect()),
            Primitive::Byte | Primitive::Char | Primitive::IdlChar | Primitive::U8 => {
                List::U8(bytes.to_vec())
            }
            Primitive::I8 => List::I8(numbers!(i8)),
            Primitive::I16 => List::I16(numbers!(i16)),
            Primitive::IdlWChar | Primitive::U16 => List::U16(numbers!(u16)),
            Primitive::I32 => List::I32(numbers!(i32)),
            Primitive::U32 => List::U32(numbers!(u32)),
            Primitive::I64 => List::I64(numbers!(i64)),
            Primitive::U64 => List::U64(numbers!(u64)),
            Primitive::F32 => List::F32(numbers!(f32)),
            Primitive::F64 => List::F64(numbers!(f64)),
        })
    }

    fn string(&mut self, bound: Option<u32>) -> Result<String> {
        self.text(bound).map(str::to_owned)
    }

    pub(super) fn text(&mut self, bound: Option<u32>) -> Result<&'a str> {
        let len = self.length()?;
        let start = self.at;
        let bytes = self.take(len)?;
        let text = match bytes.split_last() {
            Some((0, text)) => text,
            // Some writers give an empty string no zero byte.
            None => &[],
            Some(_) => return Err(self.failure(DecodeFault::Terminator)),
        };
        let text = std::str::from_utf8(text).map_err(|error| {
            self.at = start + error.valid_up_to();
            self.failure(DecodeFault::Unicode)
        })?;
        self.check_bound(text, bound, start)?;
        Ok(text)
    }

    pub(super) fn wide_string(&mut self, bound: Option<u32>) -> Result<String> {
        let len = self.length()?;
        let start = self.at;
        let bytes = self.take(len.saturating_mul(4))?;
        self.slack += SLACK;
        let units = bytes.chunks_exact(4).map(|chunk| {
            let chunk: [u8; 4] = chunk.try_into().unwrap_or_default();
            let unit = if self.big_endian { u32::from_be_bytes(chunk) } else { u32::from_le_bytes(chunk) };
            u16::try_from(unit)
        });
        let units: std::result::Result<Vec<_>, _> = units.collect();
        let text = units.ok().and_then(|units| String::from_utf16(&units).ok());
        let Some(text) = text else {
            self.at = start;
            return Err(self.failure(DecodeFault::Unicode));
        };
        self.check_bound(&text, bound, start)?;
        Ok(text)
    }

    fn check_bound(&mut self, text: &str, bound: Option<u32>, start: usize) -> Result<()> {
        match bound {
            Some(bound) if text.len() > bound as usize && text.chars().count() > bound as usize => {
                self.at = start;
                Err(self.failure(DecodeFault::Bound { len: text.chars().count(), bound }))
            }
            _ => Ok(()),
        }
    }

    pub(super) fn length(&mut self) -> Result<usize> {
        self.align(4);
        let bytes: [u8; 4] = self.take(4)?.try_into().unwrap_or_default();
        let len = if self.big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) };
        Ok(len as usize)
    }

    pub(super) fn bounded_length(&mut self, bound: u32) -> Result<usize> {
        let len = self.length()?;
        if len > bound as usize {
            self.at -= 4;
            return Err(self.failure(DecodeFault::Bound { len, bound }));
        }
        Ok(len)
    }

    fn align(&mut self, size: usize) {
        self.at = self.at.next_multiple_of(size);
    }

    pub(super) fn left(&self) -> usize {
        self.body.len().saturating_sub(self.at)
    }

    pub(super) fn take(&mut self, len: usize) -> Result<&'a [u8]> {
        let end = self.at.saturating_add(len);
        match self.body.get(self.at..end) {
            Some(bytes) => {
                self.at = end;
                Ok(bytes)
            }
            None => Err(self.failure(DecodeFault::End { needed: len, left: self.left() })),
        }
    }

    pub(super) fn failure(&self, fault: DecodeFault) -> Failure {
        Failure { path: String::new(), offset: self.at, fault }
    }
}
