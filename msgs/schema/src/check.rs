// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether values fit a schema; numbers of another width are converted if nothing is lost.

use crate::{Base, FieldType, List, MessageError, Schema, Shape, Value};

/// What does not fit, and where; the path is built while the error is returned.
pub(crate) struct Misfit {
    pub path: String,
    pub reason: String,
}

impl Misfit {
    pub fn new(reason: String) -> Self {
        Self { path: String::new(), reason }
    }

    /// As an error of a message.
    pub fn of(self, schema: &Schema) -> MessageError {
        MessageError::Value { type_name: schema.name().to_string(), path: self.path, reason: self.reason }
    }

    fn inside(self, outer: &str) -> Self {
        let dot = if self.path.is_empty() || self.path.starts_with('[') { "" } else { "." };
        Self { path: format!("{outer}{dot}{}", self.path), ..self }
    }
}

/// The fields of type `index`.
pub(crate) fn structure(schema: &Schema, index: usize, values: Vec<Value>) -> Result<Vec<Value>, Misfit> {
    let node = schema.node(index);
    let fields = &node.definition.fields;
    if values.len() != fields.len() {
        return Err(Misfit::new(format!("needs {} fields, not {}", fields.len(), values.len())));
    }
    let checked = values.into_iter().zip(fields).zip(&node.nested);
    checked
        .map(|((value, ty), nested)| {
            field(schema, &ty.ty, *nested, value).map_err(|misfit| misfit.inside(&ty.name))
        })
        .collect()
}

pub(crate) fn field(
    schema: &Schema,
    ty: &FieldType,
    nested: Option<usize>,
    value: Value,
) -> Result<Value, Misfit> {
    match (ty.shape, value) {
        (Shape::Single, value) => element(schema, &ty.base, nested, value),
        (_, Value::List(list)) => {
            let len = list.len();
            check_len(ty, len)?;
            let empty = List::empty(&ty.base);
            let same = std::mem::discriminant(&empty) == std::mem::discriminant(&list);
            if same && matches!(ty.base, Base::Primitive(_)) {
                return Ok(Value::List(list));
            }
            let mut checked = empty;
            for index in 0..len {
                let value = list.get(index).unwrap_or(Value::U8(0));
                let value = element(schema, &ty.base, nested, value)
                    .and_then(|value| checked.push(value).map_err(|value| misfit(&ty.base, &value)));
                value.map_err(|misfit| misfit.inside(&format!("[{index}]")))?;
            }
            Ok(Value::List(checked))
        }
        (_, value) => Err(Misfit::new(format!("is a list: {} does not fit", value.kind()))),
    }
}

/// The value of a field without brackets, or of an element of one with.
pub(crate) fn element(
    schema: &Schema,
    base: &Base,
    nested: Option<usize>,
    value: Value,
) -> Result<Value, Misfit> {
    match (base, value) {
        (Base::Nested(_), Value::Struct(values)) => match nested {
            Some(nested) => Ok(Value::Struct(structure(schema, nested, values)?)),
            None => Err(Misfit::new("has an unknown type".to_owned())),
        },
        (Base::String { bound } | Base::WString { bound }, Value::String(text)) => {
            check_text(&text, *bound)?;
            Ok(Value::String(text))
        }
        (Base::Primitive(primitive), value) => {
            if std::mem::discriminant(&Value::zero(base)) == std::mem::discriminant(&value) {
                return Ok(value);
            }
            let converted = match &value {
                Value::F32(number) => Value::from_float(*primitive, (*number).into()),
                Value::F64(number) => Value::from_float(*primitive, *number),
                _ => value.as_integer().and_then(|number| Value::from_integer(*primitive, number)),
            };
            converted.ok_or_else(|| misfit(base, &value))
        }
        (base, value) => Err(misfit(base, &value)),
    }
}

/// Whether a list of a field has an allowed length.
pub(crate) fn check_len(ty: &FieldType, len: usize) -> Result<(), Misfit> {
    let reason = match ty.shape {
        Shape::Array(exact) if len != exact as usize => format!("needs {exact} elements, not {len}"),
        Shape::Bounded(bound) if len > bound as usize => format!("can have {bound} elements, not {len}"),
        _ if u32::try_from(len).is_err() => format!("can have {} elements, not {len}", u32::MAX),
        _ => return Ok(()),
    };
    Err(Misfit::new(reason))
}

/// Whether a text has an allowed length.
pub(crate) fn check_text(text: &str, bound: Option<u32>) -> Result<(), Misfit> {
    // The length on the wire counts the zero byte too.
    if text.len() >= u32::MAX as usize {
        return Err(Misfit::new(format!("can have {} bytes, not {}", u32::MAX - 1, text.len())));
    }
    match bound {
        Some(bound) if text.len() > bound as usize && text.chars().count() > bound as usize => {
            Err(Misfit::new(format!("can have {bound} characters, not {}", text.chars().count())))
        }
        _ => Ok(()),
    }
}

fn misfit(base: &Base, value: &Value) -> Misfit {
    let what = match value {
        Value::F32(_)
        | Value::F64(_)
        | Value::Bool(_)
        | Value::String(_)
        | Value::Struct(_)
        | Value::List(_) => value.kind().to_owned(),
        integer => integer.as_integer().unwrap_or(0).to_string(),
    };
    Misfit::new(format!("is of type {base}: {what} does not fit"))
}
