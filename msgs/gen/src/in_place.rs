// SPDX-License-Identifier: MIT OR Apache-2.0
//! The types by which a field is read and written in place: that of its getter and that of its sizes.

use tautline_schema::{Base, FieldType, Schema, SchemaError, Shape};

use crate::Options;
use crate::memory::Memory;
use crate::names::{Taken, relative};
use crate::types::{form, rust};

/// Writes types as code in the module `module` has them.
pub struct Types<'a> {
    pub schema: &'a Schema,
    pub module: &'a str,
    pub options: &'a Options,
    pub taken: &'a Taken,
}

/// The type of a message's sizes.
pub struct Sizes {
    /// `()` if there is none.
    pub ty: String,
    /// The fields that have sizes, and the types of these.
    pub fields: Vec<(String, String)>,
}

impl Types<'_> {
    /// The return type of a field's getter.
    pub fn view(&self, ty: &FieldType) -> Result<String, SchemaError> {
        let Self { module, options, .. } = *self;
        let single = FieldType { base: ty.base.clone(), shape: Shape::Single };
        let seq = || format!("{}::cdr::Seq<'a, {}>", options.msgs, form(&single, module, options));
        let one = rust(&single, module, options);
        let as_memory = |one: String, reference: &str| match ty.shape {
            Shape::Single => format!("{reference}{one}"),
            Shape::Array(len) => format!("&'a [{one}; {len}]"),
            Shape::Bounded(_) | Shape::Unbounded => format!("&'a [{one}]"),
        };
        Ok(match (&ty.base, ty.shape) {
            (Base::Primitive(_), _) => as_memory(one, ""),
            (Base::String { .. }, Shape::Single) => "&'a str".to_owned(),
            (Base::WString { .. }, Shape::Single) => format!("{}::cdr::WStr<'a>", options.msgs),
            (Base::Nested(name), shape) => match (Memory::of(&self.schema.of_part(name)?), shape) {
                (Memory::Dense, _) => as_memory(one, "&'a "),
                (_, Shape::Single) => format!("{}<'a>", self.taken.avoid(name, &one, "Ref")),
                _ => seq(),
            },
            _ => seq(),
        })
    }

    /// The sizes of the message itself.
    pub fn sizes(&self, name: &str) -> Result<Sizes, SchemaError> {
        let mut fields = Vec::new();
        for field in self.fields() {
            if let Some(ty) = self.field_sizes(&field.ty)? {
                fields.push((field.name.clone(), ty));
            }
        }
        let ty = || self.taken.avoid(self.schema.name(), name, "Sizes");
        let ty = match &fields[..] {
            [] => "()".to_owned(),
            fields if fields.iter().any(|(_, ty)| ty.contains("'s")) => format!("{}<'s>", ty()),
            _ => ty(),
        };
        Ok(Sizes { ty, fields })
    }

    fn fields(&self) -> &[tautline_schema::Field] {
        let definition = self.schema.definition();
        if definition.is_empty() { &[] } else { &definition.fields }
    }

    /// The type of a field's sizes; `None` if all its values have the same size.
    fn field_sizes(&self, ty: &FieldType) -> Result<Option<String>, SchemaError> {
        let list = matches!(ty.shape, Shape::Bounded(_) | Shape::Unbounded);
        let dense = || Ok(list.then(|| "usize".to_owned()));
        let single = match &ty.base {
            Base::Primitive(_) => return dense(),
            Base::String { .. } | Base::WString { .. } => "usize".to_owned(),
            Base::Nested(name) => {
                let schema = self.schema.of_part(name)?;
                if Memory::of(&schema) == Memory::Dense {
                    return dense();
                }
                Types { schema: &schema, ..*self }.sizes(&relative(name, self.module, self.options))?.ty
            }
        };
        Ok(match (ty.shape, &single[..]) {
            (Shape::Single | Shape::Array(_), "()") => None,
            (Shape::Single, _) => Some(single),
            _ => Some(format!("&'s [{single}]")),
        })
    }
}
