// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a message lies in memory: which of the three ways to read and write it in place its struct gets.

use tautline_schema::{Base, Definition, Layout, Schema, Shape};

/// How values of a type lie in a body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Memory {
    /// As its struct, anywhere in a body: no padding before, within or after it.
    Dense,
    /// As its struct, but only at the start of a body.
    Padded,
    /// As no struct of a fixed layout.
    Other,
}

impl Memory {
    pub fn of(schema: &Schema) -> Self {
        let all = || schema.referenced().chain([schema.definition()]);
        // A struct without fields takes no bytes in Rust, but one in CDR.
        if all().any(Definition::is_empty) {
            return Self::Other;
        }
        match Layout::of(schema).plain {
            Ok(plain)
                if plain.align == plain.first_align && content(schema, schema.definition()) == plain.size =>
            {
                Self::Dense
            }
            Ok(_) => Self::Padded,
            Err(_) => Self::Other,
        }
    }

    /// Whether its struct is `Plain`.
    pub fn is_plain(self) -> bool {
        self != Self::Other
    }
}

/// The bytes of all primitives of a message of fixed size.
fn content(schema: &Schema, definition: &Definition) -> usize {
    let sizes = definition.fields.iter().map(|field| {
        let one = match &field.ty.base {
            Base::Primitive(primitive) => primitive.size(),
            Base::Nested(name) => schema
                .referenced()
                .find(|nested| nested.name == *name)
                .map_or(0, |nested| content(schema, nested)),
            Base::String { .. } | Base::WString { .. } => 0,
        };
        match field.ty.shape {
            Shape::Array(len) => one * len as usize,
            _ => one,
        }
    });
    sizes.sum()
}
