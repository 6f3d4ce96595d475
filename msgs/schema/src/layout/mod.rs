// SPDX-License-Identifier: MIT OR Apache-2.0
//! The positions of a message's fields in its CDR, and whether C places them at the same positions.
//!
//! XCDR1 aligns each primitive to its size, counted from the start of the body; structs and arrays add no alignment.
//! A message is *plain* if it has a fixed size and C's layout of its struct is the same: the rules that the derive of
//! `tautline-msgs` proves for Rust structs. Trailing padding of the whole message does not matter.

mod facts;
mod plain;
mod position;

use crate::{FieldType, Schema};
use facts::Facts;
pub use plain::{NotPlain, Plain};
use position::Position;
pub use position::Size;

/// The layout of a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// `Ok` if the message is plain.
    pub plain: Result<Plain, NotPlain>,
    /// The length of the body in bytes.
    pub size: Size,
    /// The fields, in order.
    pub fields: Vec<FieldLayout>,
}

/// Where a field lies.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldLayout {
    /// Its name.
    pub name: String,
    /// Its type.
    pub ty: FieldType,
    /// Where its first primitive starts, in bytes from the start of the body.
    pub offset: Size,
    /// From there to the end of its last primitive, in bytes.
    pub size: Size,
}

impl Layout {
    /// The layout of a schema's type.
    pub fn of(schema: &Schema) -> Self {
        let facts = Facts::of(schema);
        let mut position = Position::start();
        let mut fields = Vec::new();
        let mut size = Size::Fixed(0);
        for (field, nested) in schema.definition().fields.iter().zip(&schema.node(0).nested) {
            position.align(facts.first_align(&field.ty, *nested));
            let offset = position.size();
            let mut alone = position.relative();
            facts.advance(&mut alone, &field.ty, *nested, &field.name);
            facts.advance(&mut position, &field.ty, *nested, &field.name);
            size = position.size();
            if !matches!(alone.size(), Size::Fixed(_)) {
                position.name_end(&field.name);
            }
            fields.push(FieldLayout {
                name: field.name.clone(),
                ty: field.ty.clone(),
                offset,
                size: alone.size(),
            });
        }
        Self { plain: facts.plain[0].clone(), size, fields }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(text: &str) -> Layout {
        Layout::of(&Schema::from_text(&"p/msg/M".parse().unwrap(), text).unwrap())
    }

    fn offsets(layout: &Layout) -> Vec<String> {
        layout.fields.iter().map(|field| format!("{}+{}", field.offset, field.size)).collect()
    }

    #[test]
    fn fixed_messages_have_offsets() {
        let tick = layout("uint64 stamp\nuint32 count\nbool valid\n");
        assert_eq!(tick.plain, Ok(Plain { size: 16, align: 8, cdr_size: 13, first_align: 8 }));
        assert_eq!(
            (offsets(&tick), tick.size),
            (vec!["0+8".into(), "8+4".into(), "12+1".into()], Size::Fixed(13))
        );
        let gap = layout("bool valid\nfloat64[3] x\nuint8[5] rest\n");
        assert_eq!(gap.plain.as_ref().unwrap().size, 40);
        assert_eq!(offsets(&gap), ["0+1", "8+24", "32+5"]);
    }

    /// The three cases that `tautline-msgs` refuses in its ui test.
    #[test]
    fn what_lies_elsewhere_in_c_is_not_plain() {
        let padded = layout("Tail a\nuint8 b\n===\nMSG: p/Tail\nuint32 x\nuint8 y\n");
        assert_eq!(padded.plain, Err(NotPlain::Misplaced { field: "b".into(), in_c: 8, in_cdr: 5 }));
        assert_eq!(offsets(&padded), ["0+5", "5+1"]);
        let aligned = layout("uint32 a\nLate b\n===\nMSG: p/Late\nuint8 x\nuint64 y\n");
        assert_eq!(aligned.plain, Err(NotPlain::Misplaced { field: "b".into(), in_c: 8, in_cdr: 4 }));
        assert_eq!(offsets(&aligned), ["0+4", "4+12"]);
        let array = layout("Tail[3] a\n===\nMSG: p/Tail\nuint16 x\nuint8 y\n");
        assert!(array.plain.is_ok(), "3 bytes rounded up to 2 are 4 in both");
        let array = layout("Tail[9] a\nuint8 end\n===\nMSG: p/Tail\nuint8 w\nuint32 x\nuint8 y\n");
        assert_eq!(array.plain, Err(NotPlain::Array { field: "a".into() }));
        // 1, 4..8, 8, then 9, 12..16, 16, ...: each 8 bytes on from the one before.
        assert_eq!(offsets(&array), ["0+73", "73+1"]);
    }

    #[test]
    fn variable_messages_have_formulas() {
        let image = layout("uint32 height\nstring encoding\nuint8 big\nuint32 step\nuint8[] data\n");
        assert_eq!(image.plain, Err(NotPlain::Variable { field: "encoding".into() }));
        let expected = [
            "0+4",
            "4+|encoding| + 5",
            "end(encoding)+1",
            "up4(end(encoding) + 1)+4",
            "up4(end(encoding) + 1) + 4+|data| + 4",
        ];
        assert_eq!(offsets(&image), expected);
        assert_eq!(image.size.to_string(), "up4(end(encoding) + 1) + |data| + 8");
    }

    /// The time is in proportion to the values, of which a short definition may have many.
    #[test]
    fn formulas_of_many_values_are_cut_off() {
        let levels = (1..=16).map(|level| format!("A{level} a\nA{level} b\n===\nMSG: p/A{level}\n"));
        let many = layout(&(levels.collect::<String>() + "string s\nfloat64 f\n"));
        for size in many.fields.iter().flat_map(|field| [&field.offset, &field.size]).chain([&many.size]) {
            assert!(size.to_string().len() < 500, "{size}");
        }
        assert!(many.size.to_string().contains(" + ..."), "{}", many.size);
    }

    #[test]
    fn padding_within_a_field_depends_on_where_it_starts() {
        let lists = layout(
            "float64[] x\nfloat64[] y\nInner[2] z\nInner inner\n===\nMSG: p/Inner\nstring s\nbool b\n",
        );
        assert_eq!(
            offsets(&lists),
            ["0+8·|x| + 8", "end(x)+pad8 + 8·|y| + 4", "end(y)+bytes(z)", "up4(end(z))+|inner.s| + 6",]
        );
        assert_eq!(lists.plain, Err(NotPlain::Variable { field: "x".into() }));
        let inner = layout("Inner inner\n===\nMSG: p/Inner\nstring s\n");
        assert_eq!(inner.plain, Err(NotPlain::Variable { field: "inner.s".into() }));
    }
}
