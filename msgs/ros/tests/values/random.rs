// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random values of any type.

use std::sync::Arc;

use rand::rngs::StdRng;
use rand::{Rng, RngExt};
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
        Shape::Single => return single(rng, schema, &ty.base, depth),
        Shape::Array(len) => len,
        Shape::Bounded(bound) => rng.random_range(0..=bound.min(most)),
        Shape::Unbounded => rng.random_range(0..=most),
    };
    let items = (0..len).map(|_| single(rng, schema, &ty.base, depth));
    list(&ty.base, items.collect())
}

fn single(rng: &mut StdRng, schema: &Schema, base: &Base, depth: u32) -> Value {
    match base {
        Base::Primitive(primitive) => number(rng, *primitive),
        Base::String { bound } | Base::WString { bound } => {
            let most = bound.unwrap_or(9).min(9);
            let len = rng.random_range(0..=most);
            Value::String((0..len).map(|_| ['a', '"', 'é', '中', '😀'][rng.random_range(0..5)]).collect())
        }
        Base::Nested(name) => {
            let definition = schema.referenced().find(|definition| definition.name == *name).unwrap();
            Value::Struct(structure(rng, schema, definition, depth + 1))
        }
    }
}

fn number(rng: &mut StdRng, primitive: Primitive) -> Value {
    let bits = rng.next_u64();
    match primitive {
        Primitive::Bool => Value::Bool(bits & 1 == 1),
        Primitive::Byte | Primitive::Char | Primitive::IdlChar | Primitive::U8 => Value::U8(bits as u8),
        Primitive::I8 => Value::I8(bits as i8),
        Primitive::I16 => Value::I16(bits as i16),
        Primitive::IdlWChar | Primitive::U16 => Value::U16(bits as u16),
        Primitive::I32 => Value::I32(bits as i32),
        Primitive::U32 => Value::U32(bits as u32),
        Primitive::I64 => Value::I64(bits as i64),
        Primitive::U64 => Value::U64(bits),
        Primitive::F32 => Value::F32(f32::from_bits(bits as u32)),
        Primitive::F64 => Value::F64(f64::from_bits(bits)),
    }
}

fn list(base: &Base, items: Vec<Value>) -> Value {
    macro_rules! collect {
        ($variant:ident) => {
            List::$variant(
                items
                    .into_iter()
                    .map(|item| match item {
                        Value::$variant(item) => item,
                        other => panic!("{other:?}"),
                    })
                    .collect(),
            )
        };
    }
    Value::List(match base {
        Base::String { .. } | Base::WString { .. } => collect!(String),
        Base::Nested(_) => collect!(Struct),
        Base::Primitive(primitive) => match primitive {
            Primitive::Bool => collect!(Bool),
            Primitive::Byte | Primitive::Char | Primitive::IdlChar | Primitive::U8 => collect!(U8),
            Primitive::I8 => collect!(I8),
            Primitive::I16 => collect!(I16),
            Primitive::IdlWChar | Primitive::U16 => collect!(U16),
            Primitive::I32 => collect!(I32),
            Primitive::U32 => collect!(U32),
            Primitive::I64 => collect!(I64),
            Primitive::U64 => collect!(U64),
            Primitive::F32 => collect!(F32),
            Primitive::F64 => collect!(F64),
        },
    })
}
