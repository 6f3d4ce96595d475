// SPDX-License-Identifier: MIT OR Apache-2.0
//! Checks whether a type's structs have the same layout in memory as in CDR.

use std::ops::Range;
use tautline_schema::{Base, Definition, Primitive, Schema, Shape};

/// A type with the same layout in memory and in CDR.
pub(crate) struct Same {
    pub(crate) len_bytes: usize,
    /// The positions of bools.
    pub(crate) bools: Vec<Range<usize>>,
}

/// Whether every field has the same position in C's struct and in CDR; `None` if not, or without fields.
pub(crate) fn same_in_memory(schema: &Schema) -> Option<Same> {
    let mut walk = Walk { schema, cdr: 0, bools: Vec::new() };
    let end = walk.message(schema.definition(), 0)?;
    (end.last > 0 && walk.cdr == end.last).then_some(Same { len_bytes: walk.cdr, bools: walk.bools })
}

/// The position of the next field in CDR.
struct Walk<'s> {
    schema: &'s Schema,
    cdr: usize,
    bools: Vec<Range<usize>>,
}

/// The end of a struct: of its last field, and including padding.
struct StructEnd {
    last: usize,
    whole: usize,
}

impl Walk<'_> {
    /// Visits a message whose struct starts at `start`.
    fn message(&mut self, definition: &Definition, start: usize) -> Option<StructEnd> {
        let mut last = start;
        for field in &definition.fields {
            let count = match field.ty.shape {
                Shape::Single => 1,
                Shape::Array(count) => count as usize,
                _ => return None,
            };
            match &field.ty.base {
                Base::Primitive(primitive) => {
                    last = self.numbers(primitive.size(), count, last)?;
                    if *primitive == Primitive::Bool {
                        self.bools.push(last - count..last);
                    }
                }
                base => {
                    for _ in 0..count {
                        last = self.nested(base, last)?;
                    }
                }
            }
        }
        let alignment = self.alignment(definition)?;
        Some(StructEnd { last, whole: last.next_multiple_of(alignment) })
    }

    /// Visits `count` numbers of `size` bytes after `end` in memory. Returns their end.
    fn numbers(&mut self, size: usize, count: usize, end: usize) -> Option<usize> {
        let place = end.next_multiple_of(size);
        self.cdr = self.cdr.next_multiple_of(size);
        let is_same = place == self.cdr;
        self.cdr += size * count;
        is_same.then_some(place + size * count)
    }

    /// Visits a message after `end` in memory. Returns its end.
    fn nested(&mut self, base: &Base, end: usize) -> Option<usize> {
        let Base::Nested(name) = base else { return None };
        let schema = self.schema;
        let definition = schema.referenced().find(|definition| definition.name == *name)?;
        let start = end.next_multiple_of(self.alignment(definition)?);
        Some(self.message(definition, start)?.whole)
    }

    /// A struct's alignment: the greatest of its fields'.
    fn alignment(&self, definition: &Definition) -> Option<usize> {
        let of = |base: &Base| match base {
            Base::Primitive(primitive) => Some(primitive.size()),
            Base::Nested(name) => {
                self.alignment(self.schema.referenced().find(|definition| definition.name == *name)?)
            }
            _ => None,
        };
        // A struct without fields has one byte, also in CDR, but no alignment.
        definition.fields.iter().try_fold(1, |most, field| Some(most.max(of(&field.ty.base)?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_after_a_struct_that_is_padded_is_elsewhere_in_cdr() {
        let same =
            |text: &str| same_in_memory(&Schema::from_text(&"a/msg/A".parse().unwrap(), text).unwrap());
        let length = |text: &str| same(text).map(|same| same.len_bytes);
        assert_eq!(same("int32 n\nbool a\nbool[3] b\nuint8 c\nbool d").unwrap().bools, [4..5, 5..8, 9..10]);
        let nested =
            |text: &str| length(&format!("{text}\n{}\nMSG: a/C\nfloat32 f\nuint8 b\n", "=".repeat(80)));
        assert_eq!(length("float64[6] x\nbool b"), Some(49));
        assert_eq!(length("uint8 a\nuint16[3] b\nint64 c"), Some(16));
        assert_eq!(length("string s"), None);
        assert_eq!(length("uint8[] s"), None);
        // The last field has the same position, the one before it has not.
        assert_eq!(nested("C c\nuint8[4] e\nfloat64 d"), None);
        assert_eq!(nested("C[2] c"), None);
        assert_eq!(nested("float32 x\nC c"), None, "padding after the last struct is not sent");
    }
}
