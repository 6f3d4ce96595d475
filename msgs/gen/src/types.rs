// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a field is in Rust: its type, its CDR form, its value.

use tautline_schema::{Base, FieldType, List, Primitive, Shape, Value};

use crate::Options;
use crate::names::relative;

/// Arrays up to this length have `Default` and serde's traits.
const LONGEST_ARRAY: u32 = 32;

/// The Rust type of a field of a message in the module `module`.
pub fn rust(ty: &FieldType, module: &str, options: &Options) -> String {
    let base = match &ty.base {
        Base::Primitive(primitive) => rust_primitive(*primitive).to_owned(),
        Base::String { .. } | Base::WString { .. } => "::std::string::String".to_owned(),
        Base::Nested(name) => relative(name, module, options),
    };
    shaped(&base, ty.shape)
}

/// The CDR form of a field, whose value is of the type that `rust` returns.
pub fn form(ty: &FieldType, module: &str, options: &Options) -> String {
    let cdr = format!("{}::cdr", options.msgs);
    let bounded = |form: String, bound: Option<u32>| match bound {
        Some(bound) => format!("{cdr}::Bounded<{form}, {bound}>"),
        None => form,
    };
    let base = match &ty.base {
        Base::Primitive(primitive) => rust_primitive(*primitive).to_owned(),
        Base::String { bound } => bounded("::std::string::String".to_owned(), *bound),
        Base::WString { bound } => bounded(format!("{cdr}::WString"), *bound),
        Base::Nested(name) => relative(name, module, options),
    };
    match ty.shape {
        Shape::Bounded(bound) => bounded(shaped(&base, ty.shape), Some(bound)),
        shape => shaped(&base, shape),
    }
}

/// The serde attribute that a field needs.
pub fn serde(ty: &FieldType, options: &Options) -> Option<String> {
    let module = match (&ty.base, ty.shape) {
        (Base::Primitive(Primitive::F32 | Primitive::F64), _) => "float",
        (_, Shape::Array(len)) if len > LONGEST_ARRAY => "array",
        _ => return None,
    };
    Some(format!("with = \"{}::serde_fields::{module}\"", options.msgs))
}

/// Whether Rust's own `Default` of the type is ROS's default, if the definition gives none.
pub fn has_default(ty: &FieldType) -> bool {
    !matches!(ty.shape, Shape::Array(len) if len > LONGEST_ARRAY)
}

/// Whether a value is Rust's own `Default` of its type.
pub fn is_zero(value: &Value) -> bool {
    match value {
        Value::Bool(value) => !value,
        Value::F32(value) => value.to_bits() == 0,
        Value::F64(value) => value.to_bits() == 0,
        Value::String(value) => value.is_empty(),
        Value::List(_) | Value::Struct(_) => false,
        integer => integer.as_integer() == Some(0),
    }
}

/// The default of a field that the definition gives none.
pub fn default_of(ty: &FieldType) -> String {
    let default = "::core::default::Default::default()";
    if has_default(ty) { default.to_owned() } else { format!("::core::array::from_fn(|_| {default})") }
}

/// The type of a constant.
pub fn constant(base: &Base) -> &'static str {
    match base {
        Base::Primitive(primitive) => rust_primitive(*primitive),
        _ => "&'static str",
    }
}

/// The value of a constant.
pub fn literal(value: &Value) -> String {
    match value {
        Value::Bool(value) => value.to_string(),
        Value::F32(value) if !value.is_finite() => special(f64::from(*value), "f32"),
        Value::F64(value) if !value.is_finite() => special(*value, "f64"),
        Value::F32(value) => format!("{value:?}"),
        Value::F64(value) => format!("{value:?}"),
        Value::String(value) => format!("{value:?}"),
        Value::List(list) => elements(list, literal),
        // Messages have neither constants nor defaults of this type.
        Value::Struct(_) => "::core::default::Default::default()".to_owned(),
        integer => integer.as_integer().unwrap_or(0).to_string(),
    }
}

/// The value of a field: as a constant, but owned.
pub fn owned(value: &Value, shape: Shape) -> String {
    match (value, shape) {
        (Value::String(text), _) if text.is_empty() => "::std::string::String::new()".to_owned(),
        (Value::String(_), _) => format!("::std::string::String::from({})", literal(value)),
        (Value::List(list), Shape::Array(_)) => elements(list, |item| owned(item, Shape::Single)),
        (Value::List(list), _) => {
            format!("::std::vec::Vec::from({})", elements(list, |item| owned(item, Shape::Single)))
        }
        _ => literal(value),
    }
}

fn elements(list: &List, write: impl Fn(&Value) -> String) -> String {
    let items = (0..list.len()).filter_map(|index| list.get(index));
    format!("[{}]", items.map(|item| write(&item)).collect::<Vec<_>>().join(", "))
}

fn special(value: f64, ty: &str) -> String {
    let name = match value {
        f64::INFINITY => "INFINITY",
        f64::NEG_INFINITY => "NEG_INFINITY",
        _ => "NAN",
    };
    format!("::core::{ty}::{name}")
}

fn shaped(base: &str, shape: Shape) -> String {
    match shape {
        Shape::Single => base.to_owned(),
        Shape::Array(len) => format!("[{base}; {len}]"),
        Shape::Bounded(_) | Shape::Unbounded => format!("::std::vec::Vec<{base}>"),
    }
}

fn rust_primitive(primitive: Primitive) -> &'static str {
    match primitive {
        Primitive::Bool => "bool",
        Primitive::Byte | Primitive::Char | Primitive::IdlChar | Primitive::U8 => "u8",
        Primitive::I8 => "i8",
        Primitive::I16 => "i16",
        Primitive::IdlWChar | Primitive::U16 => "u16",
        Primitive::I32 => "i32",
        Primitive::U32 => "u32",
        Primitive::I64 => "i64",
        Primitive::U64 => "u64",
        Primitive::F32 => "f32",
        Primitive::F64 => "f64",
    }
}
