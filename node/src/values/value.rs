// SPDX-License-Identifier: MIT OR Apache-2.0
//! The values and types of parameters.

use std::fmt;

/// The value of a parameter.
#[derive(Debug, PartialEq, Clone, Default)]
#[allow(missing_docs, reason = "the names say it")]
pub enum ParameterValue {
    #[default]
    NotSet,
    Bool(bool),
    Integer(i64),
    Double(f64),
    String(String),
    BoolArray(Vec<bool>),
    ByteArray(Vec<u8>),
    IntegerArray(Vec<i64>),
    DoubleArray(Vec<f64>),
    StringArray(Vec<String>),
}

/// The type of a parameter; its number is that of `rcl_interfaces/msg/ParameterType`.
#[derive(Debug, PartialEq, Eq, Clone, Copy, Default)]
#[allow(missing_docs, reason = "the names say it")]
#[repr(u8)]
pub enum ParameterType {
    #[default]
    NotSet = 0,
    Bool = 1,
    Integer = 2,
    Double = 3,
    String = 4,
    ByteArray = 5,
    BoolArray = 6,
    IntegerArray = 7,
    DoubleArray = 8,
    StringArray = 9,
}

tautline_rt::names!(ParameterType: pub const fn name(self) -> &'static str {
    NotSet: "not set", Bool: "boolean", Integer: "integer", Double: "double", String: "string",
    ByteArray: "byte array", BoolArray: "boolean array", IntegerArray: "integer array",
    DoubleArray: "double array", StringArray: "string array",
});

impl ParameterValue {
    /// Its type.
    pub const fn parameter_type(&self) -> ParameterType {
        match self {
            ParameterValue::NotSet => ParameterType::NotSet,
            ParameterValue::Bool(_) => ParameterType::Bool,
            ParameterValue::Integer(_) => ParameterType::Integer,
            ParameterValue::Double(_) => ParameterType::Double,
            ParameterValue::String(_) => ParameterType::String,
            ParameterValue::BoolArray(_) => ParameterType::BoolArray,
            ParameterValue::ByteArray(_) => ParameterType::ByteArray,
            ParameterValue::IntegerArray(_) => ParameterType::IntegerArray,
            ParameterValue::DoubleArray(_) => ParameterType::DoubleArray,
            ParameterValue::StringArray(_) => ParameterType::StringArray,
        }
    }

    /// The name of its type.
    pub const fn type_name(&self) -> &'static str {
        self.parameter_type().name()
    }

    fn is_no(&self, expected: ParameterType) -> WrongParameterType {
        let (expected_type_name, actual_type_name) = (expected.name(), self.type_name());
        WrongParameterType { expected_type_name, actual_type_name }
    }

    /// Converts to `wanted` what YAML has no type for: an empty array, or bytes.
    pub(crate) fn of_type(self, wanted: ParameterType) -> Self {
        match (self, wanted) {
            (Self::StringArray(empty), _) if !empty.is_empty() => Self::StringArray(empty),
            (Self::StringArray(_), ParameterType::BoolArray) => Self::BoolArray(Vec::new()),
            (Self::StringArray(_), ParameterType::ByteArray) => Self::ByteArray(Vec::new()),
            (Self::StringArray(_), ParameterType::IntegerArray) => Self::IntegerArray(Vec::new()),
            (Self::StringArray(_), ParameterType::DoubleArray) => Self::DoubleArray(Vec::new()),
            // A sequence of small integers is how YAML writes bytes.
            (Self::IntegerArray(integers), ParameterType::ByteArray) => {
                match integers.iter().map(|integer| u8::try_from(*integer)).collect() {
                    Ok(bytes) => Self::ByteArray(bytes),
                    Err(_) => Self::IntegerArray(integers),
                }
            }
            (value, _) => value,
        }
    }
}

/// As in YAML: `[1, 2]`.
impl fmt::Display for ParameterValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ParameterValue::NotSet => write!(f, "not set"),
            ParameterValue::Bool(value) => write!(f, "{value}"),
            ParameterValue::Integer(value) => write!(f, "{value}"),
            ParameterValue::Double(value) => write!(f, "{value:?}"),
            ParameterValue::String(value) => write!(f, "{value}"),
            ParameterValue::BoolArray(values) => write!(f, "{values:?}"),
            ParameterValue::ByteArray(values) => write!(f, "{values:?}"),
            ParameterValue::IntegerArray(values) => write!(f, "{values:?}"),
            ParameterValue::DoubleArray(values) => write!(f, "{values:?}"),
            ParameterValue::StringArray(values) => write!(f, "{values:?}"),
        }
    }
}

/// A value is of another type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("got `{actual_type_name}`, expected `{expected_type_name}`")]
pub struct WrongParameterType {
    /// The requested type.
    pub expected_type_name: &'static str,
    /// The value's type.
    pub actual_type_name: &'static str,
}

/// The type in a message is not one of `rcl_interfaces/msg/ParameterType`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{number} is not a type of parameters, which are 0 to 9")]
pub struct UnknownParameterType {
    /// The type's number.
    pub number: u8,
}

/// A Rust type that a parameter's value can have: those of [`ParameterValue`], and `ParameterValue` for parameters of any type.
pub trait ParameterVariant: Clone + Into<ParameterValue> + Send + Sync + 'static {
    /// The parameter's type; `None` if it may be any.
    const TYPE: Option<ParameterType>;

    /// # Errors
    /// The value is of another type.
    fn from_value(value: ParameterValue) -> Result<Self, WrongParameterType>;
}

impl ParameterVariant for ParameterValue {
    const TYPE: Option<ParameterType> = None;

    fn from_value(value: ParameterValue) -> Result<ParameterValue, WrongParameterType> {
        Ok(value)
    }
}

impl TryFrom<ParameterValue> for () {
    type Error = WrongParameterType;

    fn try_from(value: ParameterValue) -> Result<(), WrongParameterType> {
        match value {
            ParameterValue::NotSet => Ok(()),
            other => Err(other.is_no(ParameterType::NotSet)),
        }
    }
}

macro_rules! variant {
    ($type:ty, $variant:ident) => {
        impl ParameterVariant for $type {
            const TYPE: Option<ParameterType> = Some(ParameterType::$variant);

            fn from_value(value: ParameterValue) -> Result<$type, WrongParameterType> {
                value.try_into()
            }
        }

        impl From<$type> for ParameterValue {
            fn from(value: $type) -> ParameterValue {
                ParameterValue::$variant(value)
            }
        }

        impl TryFrom<ParameterValue> for $type {
            type Error = WrongParameterType;

            fn try_from(value: ParameterValue) -> Result<$type, WrongParameterType> {
                match value {
                    ParameterValue::$variant(value) => Ok(value),
                    other => Err(other.is_no(ParameterType::$variant)),
                }
            }
        }

        impl TryFrom<ParameterValue> for Option<$type> {
            type Error = WrongParameterType;

            fn try_from(value: ParameterValue) -> Result<Option<$type>, WrongParameterType> {
                match value {
                    ParameterValue::NotSet => Ok(None),
                    set => set.try_into().map(Some),
                }
            }
        }
    };
}

variant!(bool, Bool);
variant!(i64, Integer);
variant!(f64, Double);
variant!(String, String);
variant!(Vec<bool>, BoolArray);
variant!(Vec<u8>, ByteArray);
variant!(Vec<i64>, IntegerArray);
variant!(Vec<f64>, DoubleArray);
variant!(Vec<String>, StringArray);

impl From<&str> for ParameterValue {
    fn from(value: &str) -> ParameterValue {
        ParameterValue::String(value.to_owned())
    }
}
