// SPDX-License-Identifier: MIT OR Apache-2.0
//! The content of a definition, before the types it names are looked up.

use std::sync::Arc;

use crate::{Base, FieldType, Place, Primitive, Shape, TypeName, Value};

/// A field of a message.
#[derive(Clone, Debug)]
pub struct Field {
    /// Its name.
    pub name: String,
    /// Its type.
    pub ty: FieldType,
    /// Its default, of the field's type. Without one it is 0, empty or made of defaults.
    pub default: Option<Value>,
    /// The default as type descriptions write it, empty if there is none. No part of the type hash.
    pub default_text: String,
    /// The comment above and beside it, lines joined by `\n`; empty if there is none.
    pub docs: String,
    /// Where it is defined.
    pub place: Place,
}

/// A constant of a message.
#[derive(Clone, Debug)]
pub struct Constant {
    /// Its name.
    pub name: String,
    /// Its type: a primitive, `string` or `wstring`.
    pub ty: Base,
    /// Its value, of that type.
    pub value: Value,
    /// The comment above and beside it, lines joined by `\n`; empty if there is none.
    pub docs: String,
}

/// One message; or a service or action, whose fields are the types it consists of, as in type descriptions.
#[derive(Clone, Debug)]
pub struct Definition {
    /// Its name.
    pub name: TypeName,
    /// Its fields, at least one: an empty message has `uint8 structure_needs_at_least_one_member`.
    pub fields: Vec<Field>,
    /// Its constants.
    pub constants: Vec<Constant>,
    /// The comment at its start, lines joined by `\n`; empty if there is none.
    pub docs: String,
    /// The file or text it comes from.
    pub file: Arc<str>,
}

/// The field that ROS gives messages without fields, since C and IDL have no empty structs.
pub(crate) const EMPTY_MEMBER: &str = "structure_needs_at_least_one_member";

impl Definition {
    /// Whether it defines no field, and has only `EMPTY_MEMBER`.
    pub fn is_empty(&self) -> bool {
        let byte = FieldType { base: Base::Primitive(Primitive::U8), shape: Shape::Single };
        matches!(&self.fields[..], [field] if field.name == EMPTY_MEMBER && field.ty == byte)
    }
}
