// SPDX-License-Identifier: MIT OR Apache-2.0
//! The types of fields.

use std::fmt;

use crate::TypeName;

/// A type of fixed size that is built in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Primitive {
    /// `bool`: one byte, 0 or 1.
    Bool,
    /// `byte`: 8 bits without a meaning.
    Byte,
    /// `char`: in ROS 2's definitions another name of `uint8`.
    Char,
    /// The `char` of IDL files, 8 bits, which no `.msg` file can define. `idl_char` in texts.
    IdlChar,
    /// The `wchar` of IDL files, 16 bits, which no `.msg` file can define. `idl_wchar` in texts.
    IdlWChar,
    /// `int8`.
    I8,
    /// `uint8`.
    U8,
    /// `int16`.
    I16,
    /// `uint16`.
    U16,
    /// `int32`.
    I32,
    /// `uint32`.
    U32,
    /// `int64`.
    I64,
    /// `uint64`.
    U64,
    /// `float32`.
    F32,
    /// `float64`.
    F64,
}

impl Primitive {
    const ALL: [(Self, &'static str); 15] = [
        (Self::Bool, "bool"),
        (Self::Byte, "byte"),
        (Self::Char, "char"),
        (Self::IdlChar, "idl_char"),
        (Self::IdlWChar, "idl_wchar"),
        (Self::I8, "int8"),
        (Self::U8, "uint8"),
        (Self::I16, "int16"),
        (Self::U16, "uint16"),
        (Self::I32, "int32"),
        (Self::U32, "uint32"),
        (Self::I64, "int64"),
        (Self::U64, "uint64"),
        (Self::F32, "float32"),
        (Self::F64, "float64"),
    ];

    /// Its name in definitions.
    pub fn as_str(self) -> &'static str {
        Self::ALL.iter().find(|entry| entry.0 == self).map_or("", |entry| entry.1)
    }

    /// The inverse of [`as_str`](Self::as_str).
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().find(|entry| entry.1 == name).map(|entry| entry.0)
    }

    /// Its size in bytes, which is its alignment as well.
    pub fn size(self) -> usize {
        match self {
            Self::Bool | Self::Byte | Self::Char | Self::IdlChar | Self::I8 | Self::U8 => 1,
            Self::IdlWChar | Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }
}

/// The type of one element of a field.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Base {
    /// A number, `bool`, `byte` or `char`.
    Primitive(Primitive),
    /// `string` or `string<=N`: UTF-8, at most N characters.
    String {
        /// The most characters.
        bound: Option<u32>,
    },
    /// `wstring` or `wstring<=N`: UTF-16 on the wire, at most N characters.
    WString {
        /// The most characters.
        bound: Option<u32>,
    },
    /// Another message.
    Nested(TypeName),
}

/// How many elements a field has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Shape {
    /// One, without brackets.
    Single,
    /// `[N]`: exactly N, at least 1.
    Array(u32),
    /// `[<=N]`: at most N, at least 1.
    Bounded(u32),
    /// `[]`: any number.
    Unbounded,
}

/// The type of a field.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct FieldType {
    /// The type of one element.
    pub base: Base,
    /// How many elements there are.
    pub shape: Shape,
}

/// As definitions write it: `string<=5[<=3]`, `geometry_msgs/Point[]`. Types that are no messages have their full name.
impl fmt::Display for FieldType {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}", self.base)?;
        match self.shape {
            Shape::Single => Ok(()),
            Shape::Array(len) => write!(formatter, "[{len}]"),
            Shape::Bounded(bound) => write!(formatter, "[<={bound}]"),
            Shape::Unbounded => formatter.write_str("[]"),
        }
    }
}

impl fmt::Display for Base {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Primitive(primitive) => formatter.write_str(primitive.as_str()),
            Self::String { bound: None } => formatter.write_str("string"),
            Self::String { bound: Some(bound) } => write!(formatter, "string<={bound}"),
            Self::WString { bound: None } => formatter.write_str("wstring"),
            Self::WString { bound: Some(bound) } => write!(formatter, "wstring<={bound}"),
            Self::Nested(name) => formatter.write_str(&short_name(name)),
        }
    }
}

/// `package/Name` for a message, the full name otherwise.
pub(crate) fn short_name(name: &TypeName) -> String {
    match name.kind() {
        crate::Kind::Msg => format!("{}/{}", name.package(), name.name()),
        _ => name.to_string(),
    }
}
