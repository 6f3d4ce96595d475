// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random values of any type.

use std::sync::Arc;

use rand::RngExt;
use rand::rngs::StdRng;
use tautline_schema::{Base, Definition, DynamicMessage, FieldType, List, Primitive, Schema, Shape, Value};

pub fn message(rng: &mut StdRng, schema: &Arc<Schema>) -> DynamicMessage {
    let fields = structure(rng, schema, schema.definition(), 0);
    DynamicMessage::from_fields(schema, fields).unwrap()
}

fn structure(rng: &mut StdRng, schema: &Schema, definition: &Definition, depth: u32) -> Vec<Value> {
    if definition.is_empty() {
        return vec![Value::U8(0)];
    }
    definition.fields.iter().map(|field| value(rng, schema, &field.ty, depth)).collect()
}

fn value(rng: &mut StdRng, schema: &Schema, ty: &FieldType, depth: u32) -> Value {
    let most = 5 >> depth.min(2);
    let len = match ty.shape {
        Shape::Single => None,
        Shape::Array(len) => Some(len),
        Shape::Bounded(bound) => Some(rng.random_range(0..=bound.min(most))),
        Shape::Unbounded => Some(rng.random_range(0..=most)),
    };
    macro_rules! one_or_list {
        ($variant:ident, $random:expr) => {
            match len {
                None => Value::$variant($random),
                Some(len) => Value::List(List::$variant((0..len).map(|_| $random).collect())),
            }
        };
    }
    match &ty.base {
        Base::Primitive(primitive) => match primitive {
            Primitive::Bool => one_or_list!(Bool, rng.random::<bool>()),
            Primitive::Byte | Primitive::Char | Primitive::IdlChar | Primitive::U8 => {
                one_or_list!(U8, rng.random::<u8>())
            }
            Primitive::I8 => one_or_list!(I8, rng.random::<i8>()),
            Primitive::I16 => one_or_list!(I16, rng.random::<i16>()),
            Primitive::IdlWChar | Primitive::U16 => one_or_list!(U16, rng.random::<u16>()),
            Primitive::I32 => one_or_list!(I32, rng.random::<i32>()),
            Primitive::U32 => one_or_list!(U32, rng.random::<u32>()),
            Primitive::I64 => one_or_list!(I64, rng.random::<i64>()),
            Primitive::U64 => one_or_list!(U64, rng.random::<u64>()),
            Primitive::F32 => one_or_list!(F32, f32::from_bits(rng.random())),
            Primitive::F64 => one_or_list!(F64, f64::from_bits(rng.random())),
        },
        Base::String { bound } | Base::WString { bound } => one_or_list!(String, text(rng, *bound)),
        Base::Nested(name) => {
            let definition = schema.referenced().find(|definition| definition.name == *name).unwrap();
            one_or_list!(Struct, structure(rng, schema, definition, depth + 1))
        }
    }
}

fn text(rng: &mut StdRng, bound: Option<u32>) -> String {
    let len = rng.random_range(0..=bound.unwrap_or(9).min(9));
    (0..len).map(|_| ['a', '"', 'é', '中', '😀'][rng.random_range(0..5)]).collect()
}
