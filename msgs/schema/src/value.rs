// SPDX-License-Identifier: MIT OR Apache-2.0
//! Values whose type is known at run time only.

use crate::{Base, Primitive};

/// The value of a field, or of a message: [`Value::Struct`].
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// `bool`.
    Bool(bool),
    /// `int8`.
    I8(i8),
    /// `uint8`, `byte` and `char`.
    U8(u8),
    /// `int16`.
    I16(i16),
    /// `uint16`.
    U16(u16),
    /// `int32`.
    I32(i32),
    /// `uint32`.
    U32(u32),
    /// `int64`.
    I64(i64),
    /// `uint64`.
    U64(u64),
    /// `float32`.
    F32(f32),
    /// `float64`.
    F64(f64),
    /// `string` and `wstring`.
    String(String),
    /// A message: its fields in the order of their definition.
    Struct(Vec<Value>),
    /// An array or sequence.
    List(List),
}

/// The elements of an array or sequence, numbers packed.
#[derive(Clone, Debug, PartialEq)]
pub enum List {
    /// Of `bool`.
    Bool(Vec<bool>),
    /// Of `int8`.
    I8(Vec<i8>),
    /// Of `uint8`, `byte` and `char`.
    U8(Vec<u8>),
    /// Of `int16`.
    I16(Vec<i16>),
    /// Of `uint16`.
    U16(Vec<u16>),
    /// Of `int32`.
    I32(Vec<i32>),
    /// Of `uint32`.
    U32(Vec<u32>),
    /// Of `int64`.
    I64(Vec<i64>),
    /// Of `uint64`.
    U64(Vec<u64>),
    /// Of `float32`.
    F32(Vec<f32>),
    /// Of `float64`.
    F64(Vec<f64>),
    /// Of `string` and `wstring`.
    String(Vec<String>),
    /// Of messages, each the fields of one.
    Struct(Vec<Vec<Value>>),
}

/// Runs the same code for every type of elements.
macro_rules! for_each_list {
    ($list:expr, $items:ident => $body:expr) => {
        match $list {
            List::Bool($items) => $body,
            List::I8($items) => $body,
            List::U8($items) => $body,
            List::I16($items) => $body,
            List::U16($items) => $body,
            List::I32($items) => $body,
            List::U32($items) => $body,
            List::I64($items) => $body,
            List::U64($items) => $body,
            List::F32($items) => $body,
            List::F64($items) => $body,
            List::String($items) => $body,
            List::Struct($items) => $body,
        }
    };
}

impl List {
    /// How many elements there are.
    pub fn len(&self) -> usize {
        for_each_list!(self, items => items.len())
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Element `index`, copied.
    pub fn get(&self, index: usize) -> Option<Value> {
        for_each_list!(self, items => items.get(index).cloned().map(Element::into_value))
    }

    /// Replaces element `index`; gives the value back if there is no such element or the types differ.
    pub(crate) fn set(&mut self, index: usize, value: Value) -> Result<(), Value> {
        for_each_list!(self, items => match items.get_mut(index) {
            Some(item) => Element::of_value(value).map(|value| *item = value),
            None => Err(value),
        })
    }

    /// Appends an element; gives the value back if the types differ.
    pub(crate) fn push(&mut self, value: Value) -> Result<(), Value> {
        for_each_list!(self, items => Element::of_value(value).map(|value| items.push(value)))
    }

    /// An empty list of elements of this type.
    pub(crate) fn empty(base: &Base) -> Self {
        match base {
            Base::Primitive(primitive) => match primitive {
                Primitive::Bool => Self::Bool(Vec::new()),
                Primitive::Byte | Primitive::Char | Primitive::IdlChar | Primitive::U8 => {
                    Self::U8(Vec::new())
                }
                Primitive::I8 => Self::I8(Vec::new()),
                Primitive::I16 => Self::I16(Vec::new()),
                Primitive::IdlWChar | Primitive::U16 => Self::U16(Vec::new()),
                Primitive::I32 => Self::I32(Vec::new()),
                Primitive::U32 => Self::U32(Vec::new()),
                Primitive::I64 => Self::I64(Vec::new()),
                Primitive::U64 => Self::U64(Vec::new()),
                Primitive::F32 => Self::F32(Vec::new()),
                Primitive::F64 => Self::F64(Vec::new()),
            },
            Base::String { .. } | Base::WString { .. } => Self::String(Vec::new()),
            Base::Nested(_) => Self::Struct(Vec::new()),
        }
    }

    /// `len` zeros or empty strings. Not for messages: theirs are made of defaults.
    pub(crate) fn zeros(base: &Base, len: usize) -> Self {
        let mut list = Self::empty(base);
        for_each_list!(&mut list, items => items.resize(len, Default::default()));
        list
    }
}

/// The type of a list's elements.
trait Element: Sized {
    fn into_value(self) -> Value;
    /// Gives the value back if it is of another type.
    fn of_value(value: Value) -> Result<Self, Value>;
}

macro_rules! elements {
    ($($variant:ident: $type:ty),*) => {
        $(impl Element for $type {
            fn into_value(self) -> Value {
                Value::$variant(self)
            }

            fn of_value(value: Value) -> Result<Self, Value> {
                if let Value::$variant(value) = value { Ok(value) } else { Err(value) }
            }
        })*
    };
}

elements!(Bool: bool, I8: i8, U8: u8, I16: i16, U16: u16, I32: i32, U32: u32, I64: i64, U64: u64, F32: f32, F64: f64);
elements!(String: String, Struct: Vec<Value>);

impl Value {
    /// 0, `false` or the empty string. A message's value is made of defaults instead.
    pub(crate) fn zero(base: &Base) -> Self {
        List::zeros(base, 1).get(0).unwrap_or(Self::Struct(Vec::new()))
    }

    /// What kind of value it is, for error messages.
    pub(crate) fn kind(&self) -> &'static str {
        match self {
            Self::Bool(_) => "a bool",
            Self::I8(_) => "an int8",
            Self::U8(_) => "a uint8",
            Self::I16(_) => "an int16",
            Self::U16(_) => "a uint16",
            Self::I32(_) => "an int32",
            Self::U32(_) => "a uint32",
            Self::I64(_) => "an int64",
            Self::U64(_) => "a uint64",
            Self::F32(_) => "a float32",
            Self::F64(_) => "a float64",
            Self::String(_) => "a string",
            Self::Struct(_) => "a message",
            Self::List(_) => "a list",
        }
    }

    /// An integer, whatever its width.
    pub fn as_integer(&self) -> Option<i128> {
        Some(match *self {
            Self::I8(value) => value.into(),
            Self::U8(value) => value.into(),
            Self::I16(value) => value.into(),
            Self::U16(value) => value.into(),
            Self::I32(value) => value.into(),
            Self::U32(value) => value.into(),
            Self::I64(value) => value.into(),
            Self::U64(value) => value.into(),
            _ => return None,
        })
    }

    /// A number as `f64`, whatever its type. 64-bit integers are rounded.
    pub fn as_f64(&self) -> Option<f64> {
        match *self {
            Self::F32(value) => Some(value.into()),
            Self::F64(value) => Some(value),
            _ => self.as_integer().map(|value| value as f64),
        }
    }

    /// A `bool`.
    pub fn as_bool(&self) -> Option<bool> {
        if let Self::Bool(value) = self { Some(*value) } else { None }
    }

    /// A `string` or `wstring`.
    pub fn as_str(&self) -> Option<&str> {
        if let Self::String(value) = self { Some(value) } else { None }
    }

    /// The integer as a value of this type; `None` if it does not fit or the type is no number.
    pub(crate) fn from_integer(primitive: Primitive, value: i128) -> Option<Self> {
        Some(match primitive {
            Primitive::Bool => return None,
            Primitive::Byte | Primitive::Char | Primitive::IdlChar | Primitive::U8 => {
                Self::U8(value.try_into().ok()?)
            }
            Primitive::I8 => Self::I8(value.try_into().ok()?),
            Primitive::I16 => Self::I16(value.try_into().ok()?),
            Primitive::IdlWChar | Primitive::U16 => Self::U16(value.try_into().ok()?),
            Primitive::I32 => Self::I32(value.try_into().ok()?),
            Primitive::U32 => Self::U32(value.try_into().ok()?),
            Primitive::I64 => Self::I64(value.try_into().ok()?),
            Primitive::U64 => Self::U64(value.try_into().ok()?),
            Primitive::F32 => Self::F32(value as f32),
            Primitive::F64 => Self::F64(value as f64),
        })
    }

    /// The number as a value of this type; `None` if the type is no float, or a finite number is too large for it.
    pub(crate) fn from_float(primitive: Primitive, value: f64) -> Option<Self> {
        match primitive {
            Primitive::F32 if value.is_finite() && !(value as f32).is_finite() => None,
            Primitive::F32 => Some(Self::F32(value as f32)),
            Primitive::F64 => Some(Self::F64(value)),
            _ => None,
        }
    }
}

/// Numbers as values, so that `message.set("x", 1.5)` can be written.
macro_rules! from {
    ($($variant:ident: $type:ty),*) => {
        $(impl From<$type> for Value {
            fn from(value: $type) -> Self {
                Self::$variant(value)
            }
        }

        impl From<Vec<$type>> for Value {
            fn from(items: Vec<$type>) -> Self {
                Self::List(List::$variant(items))
            }
        })*
    };
}

from!(Bool: bool, I8: i8, U8: u8, I16: i16, U16: u16, I32: i32, U32: u32, I64: i64, U64: u64, F32: f32, F64: f64, String: String);

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::String(text.to_owned())
    }
}
