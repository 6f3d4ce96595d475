// SPDX-License-Identifier: MIT OR Apache-2.0
//! Checks whether bytes are a message without building values: the same result as the reader's, at the cost of
//! one pass over the bytes.

use super::read::{Reader, Result, SLACK};
use crate::{Base, DecodeFault, FieldType, Primitive, Shape};

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
            Shape::Bounded(bound) => match self.length()? {
                len if len > bound as usize => {
                    self.at -= 4;
                    return Err(self.failure(DecodeFault::Bound { len, bound }));
                }
                len => (len, true),
            },
        };
        let min_size = match (&ty.base, nested) {
            (Base::Primitive(primitive), _) => return self.check_primitives(*primitive, len),
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

    fn check_primitives(&mut self, primitive: Primitive, len: usize) -> Result<()> {
        let size = primitive.size();
        if len > 0 {
            self.align(size);
        } else if size == 8 {
            self.slack += SLACK;
        }
        let start = self.at;
        let bytes = self.take(len.saturating_mul(size))?;
        let wrong = match primitive {
            Primitive::Bool => bytes.iter().position(|&byte| byte > 1),
            _ => None,
        };
        match wrong.and_then(|index| Some((index, *bytes.get(index)?))) {
            Some((index, value)) => {
                self.at = start + index;
                let failure = self.failure(DecodeFault::Bool { value });
                Err(if len > 1 { failure.in_element(index) } else { failure })
            }
            None => Ok(()),
        }
    }
}
