// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads messages from any serde format according to the schema.

use std::cell::RefCell;
use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error as _, MapAccess, SeqAccess, Unexpected, Visitor};

use crate::message::defaults;
use crate::{Base, FieldType, List, Primitive, Schema, Shape, Value, check};

/// Where in the message something is read.
#[derive(Clone, Copy)]
enum Place<'a> {
    Root,
    Field(&'a Place<'a>, &'a str),
    Element(&'a Place<'a>, usize),
}

impl fmt::Display for Place<'_> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Root => Ok(()),
            Self::Field(Place::Root, name) => formatter.write_str(name),
            Self::Field(outer, name) => write!(formatter, "{outer}.{name}"),
            Self::Element(outer, index) => write!(formatter, "{outer}[{index}]"),
        }
    }
}

/// Collects the paths of times that are `now`, and of stamps in headers that are `auto`.
pub type Stamps = RefCell<Vec<String>>;

/// Reads the fields of type `node`.
pub struct Root<'a> {
    schema: &'a Schema,
    node: usize,
    place: Place<'a>,
    /// `None`: `now` and `auto` are not allowed.
    stamps: Option<&'a Stamps>,
}

impl<'a> Root<'a> {
    /// The type of the schema itself.
    pub fn seed(schema: &'a Schema, stamps: Option<&'a Stamps>) -> Self {
        Self { schema, node: 0, place: Place::Root, stamps }
    }
}

impl<'de> DeserializeSeed<'de> for Root<'_> {
    type Value = Vec<Value>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Vec<Value>, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Root<'_> {
    type Value = Vec<Value>;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = &self.schema.node(self.node).definition.name;
        match self.place {
            Place::Root => write!(formatter, "the fields of {name}"),
            place => write!(formatter, "the fields of {name} in `{place}`"),
        }
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Vec<Value>, A::Error> {
        let Self { schema, node: index, place, stamps } = self;
        let node = schema.node(index);
        let fields = &node.definition.fields;
        let mut values: Vec<Option<Value>> = vec![None; fields.len()];
        while let Some(name) = map.next_key::<String>()? {
            let position = fields.iter().position(|field| field.name == name);
            let position = position.filter(|_| !node.definition.is_empty());
            let Some(position) = position else {
                let names: Vec<_> = fields.iter().map(|field| field.name.as_str()).collect();
                let field = Place::Field(&place, &name);
                return Err(A::Error::custom(format!(
                    "there is no field `{field}`; there are {}",
                    names.join(", ")
                )));
            };
            let inner = Place::Field(&place, &name);
            let ty = &fields[position].ty;
            let value =
                map.next_value_seed(Any { schema, ty, nested: node.nested[position], place: inner, stamps })?;
            if values[position].replace(value).is_some() {
                return Err(A::Error::custom(format!("field `{inner}` is there twice")));
            }
        }
        let defaults = if values.contains(&None) { defaults(schema, index) } else { vec![] };
        let mut defaults = defaults.into_iter();
        let filled = values.into_iter().map(|value| {
            let default = defaults.next();
            value.or(default).unwrap_or(Value::U8(0))
        });
        Ok(filled.collect())
    }

    /// An empty YAML document or value.
    fn visit_unit<E>(self) -> Result<Vec<Value>, E> {
        Ok(defaults(self.schema, self.node))
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Vec<Value>, E> {
        let stamp = match (self.schema.node(self.node).definition.name.to_string().as_str(), text) {
            ("std_msgs/msg/Header", "auto") => Place::Field(&self.place, "stamp").to_string(),
            ("builtin_interfaces/msg/Time", "now") => self.place.to_string(),
            _ => return Err(E::invalid_type(Unexpected::Str(text), &self)),
        };
        let stamps = self.stamps.ok_or_else(|| E::invalid_type(Unexpected::Str(text), &self))?;
        stamps.borrow_mut().push(stamp);
        Ok(defaults(self.schema, self.node))
    }
}

/// Reads the value of a field.
struct Any<'a> {
    schema: &'a Schema,
    ty: &'a FieldType,
    nested: Option<usize>,
    place: Place<'a>,
    stamps: Option<&'a Stamps>,
}

impl<'de> DeserializeSeed<'de> for Any<'_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        match (self.ty.shape, self.nested, &self.ty.base) {
            (Shape::Single, Some(node), _) => {
                let root = Root { schema: self.schema, node, place: self.place, stamps: self.stamps };
                root.deserialize(deserializer).map(Value::Struct)
            }
            (Shape::Single, None, base) => Scalar { base, place: self.place }.deserialize(deserializer),
            _ => deserializer.deserialize_seq(self),
        }
    }
}

/// Reads an array or sequence.
impl<'de> Visitor<'de> for Any<'_> {
    type Value = Value;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "a list for `{}` of type {}", self.place, self.ty)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Value, A::Error> {
        let Self { schema, ty, nested, place, stamps } = self;
        let mut list = List::empty(&ty.base);
        for index in 0.. {
            let inner = Place::Element(&place, index);
            let element = match nested {
                Some(node) => {
                    let root = Root { schema, node, place: inner, stamps };
                    seq.next_element_seed(root)?.map(Value::Struct)
                }
                None => seq.next_element_seed(Scalar { base: &ty.base, place: inner })?,
            };
            let Some(element) = element else { break };
            if let Shape::Array(most) | Shape::Bounded(most) = ty.shape
                && index >= most as usize
            {
                return Err(A::Error::custom(format!("`{place}` can have {most} elements, not more")));
            }
            list.push(element).map_err(|_| A::Error::custom(format!("`{inner}` does not fit")))?;
        }
        let fits = check::check_len(ty, list.len());
        fits.map_err(|misfit| A::Error::custom(format!("`{place}` {}", misfit.reason)))?;
        Ok(Value::List(list))
    }
}

/// Up to this, `f64` has every integer.
const MAX_EXACT: f64 = (1u64 << 53) as f64;

/// Reads a number, `bool` or text.
struct Scalar<'a> {
    base: &'a Base,
    place: Place<'a>,
}

impl Scalar<'_> {
    fn integer<E: serde::de::Error>(&self, value: i128, shown: Unexpected<'_>) -> Result<Value, E> {
        match (self.base, value) {
            (Base::Primitive(Primitive::Bool), 0 | 1) => Some(Value::Bool(value == 1)),
            (Base::Primitive(primitive), _) => Value::from_integer(*primitive, value),
            _ => None,
        }
        .ok_or_else(|| E::invalid_value(shown, self))
    }
}

impl<'de> DeserializeSeed<'de> for Scalar<'_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        match self.base {
            // A YAML text may look like a number.
            Base::String { .. } | Base::WString { .. } => deserializer.deserialize_str(self),
            _ => deserializer.deserialize_any(self),
        }
    }
}

impl<'de> Visitor<'de> for Scalar<'_> {
    type Value = Value;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "a {} for `{}`", self.base, self.place)
    }

    fn visit_bool<E: serde::de::Error>(self, value: bool) -> Result<Value, E> {
        match self.base {
            Base::Primitive(Primitive::Bool) => Ok(Value::Bool(value)),
            _ => Err(E::invalid_type(Unexpected::Bool(value), &self)),
        }
    }

    fn visit_i64<E: serde::de::Error>(self, value: i64) -> Result<Value, E> {
        self.integer(value.into(), Unexpected::Signed(value))
    }

    fn visit_u64<E: serde::de::Error>(self, value: u64) -> Result<Value, E> {
        self.integer(value.into(), Unexpected::Unsigned(value))
    }

    fn visit_f64<E: serde::de::Error>(self, value: f64) -> Result<Value, E> {
        let float = match self.base {
            Base::Primitive(primitive) => Value::from_float(*primitive, value),
            _ => None,
        };
        match float {
            Some(float) => Ok(float),
            // A larger one may be a rounded number.
            None if value.fract() == 0.0 && value.abs() <= MAX_EXACT => {
                self.integer(value as i128, Unexpected::Float(value))
            }
            None => Err(E::invalid_value(Unexpected::Float(value), &self)),
        }
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Value, E> {
        match self.base {
            Base::String { bound } | Base::WString { bound } => {
                let fits = check::check_text(text, *bound);
                fits.map_err(|misfit| E::custom(format!("`{}` {}", self.place, misfit.reason)))?;
                Ok(Value::String(text.to_owned()))
            }
            Base::Primitive(primitive) => {
                let number = match text {
                    "NaN" | "nan" | ".nan" => Some(f64::NAN),
                    "Infinity" | "inf" | ".inf" => Some(f64::INFINITY),
                    "-Infinity" | "-inf" | "-.inf" => Some(f64::NEG_INFINITY),
                    _ => None,
                };
                let value = number.and_then(|number| Value::from_float(*primitive, number));
                value.ok_or_else(|| E::invalid_value(Unexpected::Str(text), &self))
            }
            Base::Nested(_) => Err(E::invalid_type(Unexpected::Str(text), &self)),
        }
    }
}
