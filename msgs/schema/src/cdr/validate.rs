// SPDX-License-Identifier: MIT OR Apache-2.0
//! Checks whether bytes are a message without building values: the same result as the reader's, at the cost of
//! one pass over the bytes.

use super::read::{Reader, Result};
use crate::{Base, DecodeFault, FieldType, Shape};

impl Reader<'_> {
    /// How many bytes follow the message.
    pub fn validate(mut self) -> Result<usize> {
        self.check_structure(0)?;
        self.end()
    }

    fn check_structure(&mut self, index: usize) -> Result<()> {
        let schema = self.schema;
        let node = schema.node(index);
        if node.definition.is_empty() {
            return self.take(1).map(drop);
        }
        for (field, nested) in node.definition.fields.iter().zip(&node.nested) {
            self.check_field(&field.ty, *nested).map_err(|failure| failure.in_field(&field.name))?;
        }
        Ok(())
    }

    fn check_field(&mut self, ty: &FieldType, nested: Option<usize>) -> Result<()> {
        let (len, is_list) = match ty.shape {
            Shape::Single => (1, false),
            Shape::Array(len) => (len as usize, true),
            Shape::Unbounded => (self.length()?, true),
            Shape::Bounded(bound) => (self.bounded_length(bound)?, true),
        };
        let min_size = match (&ty.base, nested) {
            (Base::Primitive(primitive), _) => {
                return self.primitive_bytes(*primitive, len).map(drop);
            }
            (Base::Nested(_), None) => return Ok(()),
            (Base::Nested(_), Some(nested)) => self.schema.node(nested).min_size,
            _ => 4,
        };
        let (needed, left) = (len.saturating_mul(min_size), self.left());
        if is_list && needed > left {
            return Err(self.failure(DecodeFault::End { needed, left }));
        }
        for index in 0..len {
            let one = match (&ty.base, nested) {
                (Base::String { bound }, _) => self.text(*bound).map(drop),
                (Base::WString { bound }, _) => self.wide_string(*bound).map(drop),
                (_, Some(nested)) => self.check_structure(nested),
                _ => Ok(()),
            };
            one.map_err(|failure| if is_list { failure.in_element(index) } else { failure })?;
        }
        Ok(())
    }
}
