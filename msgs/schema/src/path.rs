// SPDX-License-Identifier: MIT OR Apache-2.0
//! Values by path: `pose.position.x`, `ranges[3]`, `markers[0].points[2].y`.

use std::borrow::Cow;

use crate::{DynamicMessage, FieldType, List, MessageError, Schema, Value, check};

impl DynamicMessage {
    /// The value at a path, copied if it is an element of a list.
    ///
    /// # Errors
    /// [`MessageError::Path`] if there is no such field or element.
    pub fn get(&self, path: &str) -> Result<Cow<'_, Value>, MessageError> {
        Ok(self.find(path)?.0)
    }

    /// The value at a path, and the type of it or of its elements, if that is a message.
    pub(crate) fn find(&self, path: &str) -> Result<(Cow<'_, Value>, usize), MessageError> {
        let error = |reason| no_path(&self.schema, path, reason);
        let mut fields = &self.fields;
        let mut node = 0;
        let mut parts = parts(path).peekable();
        while let Some(part) = parts.next() {
            let (name, index) = part.map_err(error)?;
            let Found { field, nested, .. } = find(&self.schema, node, name).map_err(error)?;
            let last = parts.peek().is_none();
            let inner = nested.unwrap_or(0);
            fields = match (&fields[field], index) {
                (value, None) if last => return Ok((Cow::Borrowed(value), inner)),
                (Value::List(list), Some(index)) if last => {
                    let element = list.get(index).ok_or_else(|| error(no_element(index, list.len())))?;
                    return Ok((Cow::Owned(element), inner));
                }
                (Value::Struct(inner), None) => inner,
                (Value::List(List::Struct(items)), Some(index)) => {
                    items.get(index).ok_or_else(|| error(no_element(index, items.len())))?
                }
                (value, index) => return Err(error(no_step(name, value, index))),
            };
            node = inner;
        }
        Err(error("the path is empty".to_owned()))
    }

    /// Replaces the value at a path. A number of another type is converted if it fits; a list replaces the whole
    /// sequence and its length.
    ///
    /// # Errors
    /// [`MessageError::Path`] if there is no such field or element; [`MessageError::Value`] if the value is of another
    /// kind, a number out of range, or a list or text of a length that is not allowed. Nothing is changed then.
    pub fn set(&mut self, path: &str, value: impl Into<Value>) -> Result<(), MessageError> {
        let schema = self.schema.clone();
        let error = |reason| no_path(&schema, path, reason);
        let misfit = |misfit: check::Misfit| {
            check::Misfit { path: format!("{path}{}", misfit.path), ..misfit }.of(&schema)
        };
        let mut fields = &mut self.fields;
        let mut node = 0;
        let mut parts = parts(path).peekable();
        while let Some(part) = parts.next() {
            let (name, index) = part.map_err(error)?;
            let Found { field, nested, ty } = find(&schema, node, name).map_err(error)?;
            let last = parts.peek().is_none();
            fields = match (&mut fields[field], index) {
                (old, None) if last => {
                    *old = check::field(&schema, ty, nested, value.into()).map_err(misfit)?;
                    return Ok(());
                }
                (Value::List(list), Some(index)) if last => {
                    let len = list.len();
                    let value = check::element(&schema, &ty.base, nested, value.into()).map_err(misfit)?;
                    return list.set(index, value).map_err(|_| error(no_element(index, len)));
                }
                (Value::Struct(inner), None) => inner,
                (Value::List(List::Struct(items)), Some(index)) => {
                    let len = items.len();
                    items.get_mut(index).ok_or_else(|| error(no_element(index, len)))?
                }
                (value, index) => return Err(error(no_step(name, value, index))),
            };
            node = nested.unwrap_or(0);
        }
        Err(error("the path is empty".to_owned()))
    }
}

fn no_path(schema: &Schema, path: &str, reason: String) -> MessageError {
    MessageError::Path { type_name: schema.name().to_string(), path: path.to_owned(), reason }
}

fn no_element(index: usize, len: usize) -> String {
    format!("element {index} does not exist, there are {len}")
}

fn no_step(name: &str, value: &Value, index: Option<usize>) -> String {
    match (value, index) {
        (Value::List(_), None) => format!("`{name}` is a list: write `{name}[0]`"),
        (_, Some(_)) => format!("`{name}` is {}, which has no elements", value.kind()),
        (_, None) => format!("`{name}` is {}, which has no fields", value.kind()),
    }
}

struct Found<'a> {
    field: usize,
    nested: Option<usize>,
    ty: &'a FieldType,
}

fn find<'a>(schema: &'a Schema, node: usize, name: &str) -> Result<Found<'a>, String> {
    let node = schema.node(node);
    let fields = &node.definition.fields;
    match fields.iter().position(|field| field.name == name) {
        Some(field) => Ok(Found { field, nested: node.nested[field], ty: &fields[field].ty }),
        None => {
            let names: Vec<_> = fields.iter().map(|field| field.name.as_str()).collect();
            Err(format!("{} has no field `{name}`, it has {}", node.definition.name, names.join(", ")))
        }
    }
}

/// The names and indices of a path.
fn parts(path: &str) -> impl Iterator<Item = Result<(&str, Option<usize>), String>> {
    path.split('.').filter(|_| !path.is_empty()).map(|part| match part.split_once('[') {
        None => Ok((part, None)),
        Some((name, rest)) => {
            let index = rest.strip_suffix(']').and_then(|index| index.parse().ok());
            Ok((name, Some(index.ok_or_else(|| format!("`{part}` is no field and no `field[index]`"))?)))
        }
    })
}
