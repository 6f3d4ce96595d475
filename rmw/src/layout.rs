// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether a type's structs lie in memory as its CDR does.

use std::ops::Range;
use tautline_schema::{Base, Definition, Primitive, Schema, Shape};

/// Messages that lie in memory as their CDR does.
pub(crate) struct Same {
    pub(crate) len_bytes: usize,
    /// Where their bools are.
    pub(crate) bools: Vec<Range<usize>>,
}

/// Whether every field is at the same place in a struct of C's and in CDR; `None` if one is not, or if there are none.
pub(crate) fn same_in_memory(schema: &Schema) -> Option<Same> {
    let mut walk = Walk { schema, cdr: 0, bools: Vec::new() };
    let end = walk.message(schema.definition(), 0)?;
    (end.last > 0 && walk.cdr == end.last).then_some(Same { len_bytes: walk.cdr, bools: walk.bools })
}

/// Where the next field is in CDR.
struct Walk<'s> {
    schema: &'s Schema,
    cdr: usize,
    bools: Vec<Range<usize>>,
}

/// The end of a struct: that of its last field, and with what follows it for its alignment.
struct StructEnd {
    last: usize,
    whole: usize,
}

impl Walk<'_> {
    /// A message whose struct begins at `start`.
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

    /// So many of `size` bytes that come after `end` in memory. Where they end there.
    fn numbers(&mut self, size: usize, count: usize, end: usize) -> Option<usize> {
        let place = end.next_multiple_of(size);
        self.cdr = self.cdr.next_multiple_of(size);
        let is_same = place == self.cdr;
        self.cdr += size * count;
        is_same.then_some(place + size * count)
    }

    /// A message that comes after `end` in memory. Where it ends there.
    fn nested(&mut self, base: &Base, end: usize) -> Option<usize> {
        let Base::Nested(name) = base else { return None };
        let schema = self.schema;
        let definition = schema.referenced().find(|definition| definition.name == *name)?;
        let start = end.next_multiple_of(self.alignment(definition)?);
        Some(self.message(definition, start)?.whole)
    }

    /// That of a struct: the greatest of its fields'.
    fn alignment(&self, definition: &Definition) -> Option<usize> {
        let of = |base: &Base| match base {
            Base::Primitive(primitive) => Some(primitive.size()),
            Base::Nested(name) => {
                self.alignment(self.schema.referenced().find(|definition| definition.name == *name)?)
            }
            _ => None,
        };
        // One without fields has a byte that CDR has, too, but no alignment of its own.
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
        // The last field is where it is in CDR, and the one before it is not.
        assert_eq!(nested("C c\nuint8[4] e\nfloat64 d"), None);
        assert_eq!(nested("C[2] c"), None);
        assert_eq!(
            nested("float32 x\nC c"),
            None,
            "what follows the last struct for its alignment is not sent"
        );
    }
}
