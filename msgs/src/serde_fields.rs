// SPDX-License-Identifier: MIT OR Apache-2.0
//! Serde support that generated structs need in addition: floats that JSON has no number for, arrays longer
//! than 32.
//!
//! In text formats NaN and the infinities are the strings `NaN`, `Infinity` and `-Infinity`, as in dynamic messages;
//! binary formats get the number.

use core::fmt;
use core::marker::PhantomData;

use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};
use serde::ser::{Serialize, SerializeTuple, Serializer};

/// For `#[serde(with)]` on arrays of any length.
pub mod array {
    use super::{Array, Deserialize, Deserializer, Serialize, SerializeTuple, Serializer};

    #[allow(missing_docs)]
    pub fn serialize<T: Serialize, const N: usize, S: Serializer>(
        array: &[T; N],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        let mut tuple = serializer.serialize_tuple(N)?;
        array.iter().try_for_each(|item| tuple.serialize_element(item))?;
        tuple.end()
    }

    #[allow(missing_docs)]
    pub fn deserialize<'de, T: Deserialize<'de>, const N: usize, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<[T; N], D::Error> {
        deserializer.deserialize_tuple(N, Array(core::marker::PhantomData))
    }
}

/// For `#[serde(with)]` on floats, and on arrays and vectors of them.
pub mod float {
    use super::{Deserializer, Floats, Serializer};

    #[allow(missing_docs)]
    pub fn serialize<T: Floats, S: Serializer>(floats: &T, serializer: S) -> Result<S::Ok, S::Error> {
        floats.write(serializer)
    }

    #[allow(missing_docs)]
    pub fn deserialize<'de, T: Floats, D: Deserializer<'de>>(deserializer: D) -> Result<T, D::Error> {
        T::read(deserializer)
    }
}

#[allow(missing_docs)]
pub trait Floats: Sized {
    fn write<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error>;
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error>;
}

/// A float that may be one of those JSON has no number for.
struct Float<T>(T);

macro_rules! floats {
    ($($type:ident $serialize:ident $deserialize:ident)*) => {$(
        impl Floats for $type {
            fn write<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                match *self {
                    value if value.is_finite() || !serializer.is_human_readable() => {
                        serializer.$serialize(value)
                    }
                    $type::INFINITY => serializer.serialize_str("Infinity"),
                    $type::NEG_INFINITY => serializer.serialize_str("-Infinity"),
                    _ => serializer.serialize_str("NaN"),
                }
            }

            fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                if deserializer.is_human_readable() {
                    Ok(deserializer.deserialize_any(Number)? as $type)
                } else {
                    Ok(deserializer.$deserialize(Number)? as $type)
                }
            }
        }
    )*};
}

floats!(f32 serialize_f32 deserialize_f32 f64 serialize_f64 deserialize_f64);

impl<T: Floats> Serialize for Float<&T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.0.write(serializer)
    }
}

impl<'de, T: Floats> Deserialize<'de> for Float<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        T::read(deserializer).map(Self)
    }
}

impl<T: Floats> Floats for Vec<T> {
    fn write<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.iter().map(Float))
    }

    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let floats = Vec::<Float<T>>::deserialize(deserializer)?;
        Ok(floats.into_iter().map(|float| float.0).collect())
    }
}

impl<T: Floats, const N: usize> Floats for [T; N] {
    fn write<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut tuple = serializer.serialize_tuple(N)?;
        self.iter().try_for_each(|float| tuple.serialize_element(&Float(float)))?;
        tuple.end()
    }

    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let floats: [Float<T>; N] = array::deserialize(deserializer)?;
        Ok(floats.map(|float| float.0))
    }
}

/// Reads a number or one of the three strings.
struct Number;

impl Visitor<'_> for Number {
    type Value = f64;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a number, \"NaN\", \"Infinity\" or \"-Infinity\"")
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<f64, E> {
        Ok(value)
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<f64, E> {
        Ok(value as f64)
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<f64, E> {
        Ok(value as f64)
    }

    fn visit_str<E: Error>(self, value: &str) -> Result<f64, E> {
        match value {
            "NaN" => Ok(f64::NAN),
            "Infinity" => Ok(f64::INFINITY),
            "-Infinity" => Ok(f64::NEG_INFINITY),
            _ => Err(E::invalid_value(serde::de::Unexpected::Str(value), &self)),
        }
    }
}

/// Reads exactly `N` elements.
struct Array<T, const N: usize>(PhantomData<T>);

impl<'de, T: Deserialize<'de>, const N: usize> Visitor<'de> for Array<T, N> {
    type Value = [T; N];

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{N} elements")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<[T; N], A::Error> {
        let mut items = Vec::new();
        while items.len() < N {
            let item = sequence.next_element()?;
            items.push(item.ok_or_else(|| A::Error::invalid_length(items.len(), &self))?);
        }
        items.try_into().map_err(|_| A::Error::invalid_length(N, &self))
    }
}
