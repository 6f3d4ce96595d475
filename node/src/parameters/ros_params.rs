// SPDX-License-Identifier: MIT OR Apache-2.0
//! Structs whose fields are parameters.

use super::parameter::Parameter;
use crate::error::Result;
use crate::values::{ParameterError, ParameterType, ParameterValue};
use indexmap::IndexMap;
use std::fmt::Display;

/// A struct whose fields are a node's parameters: see
/// [`Parameters::declare_struct`](crate::Parameters::declare_struct). Usually derived.
///
/// A field's documentation is the parameter's description; `#[param(...)]` adds other properties:
///
/// ```
/// use tautline::RosParams;
///
/// #[derive(RosParams, Default, Debug)]
/// struct Controller {
///     /// Of the heading controller.
///     #[param(range = 0.0..=10.0, step = 0.5)]
///     gain: f64,
///     #[param(description = "Where the robot starts", read_only)]
///     frame: String,
///     limits: Limits, // its fields are called limits.speed and limits.retries
/// }
///
/// #[derive(RosParams, Default, Debug)]
/// struct Limits {
///     #[param(range = 0.0..=2.0)]
///     speed: f64,
///     retries: u8, // 0 to 255: another number is refused
/// }
/// ```
pub trait RosParams {
    /// Puts the fields into `params` under `prefix`, after it has taken the values that are there.
    ///
    /// # Errors
    /// A value in `params` does not fit.
    fn register_parameters(
        &mut self,
        prefix: &str,
        param: Option<Parameter>,
        params: &mut IndexMap<String, Parameter>,
    ) -> Result<()>;

    /// The value of a field.
    ///
    /// # Errors
    /// There is no such field.
    fn get_parameter(&mut self, param_name: &str) -> Result<ParameterValue>;

    /// Sets a field.
    ///
    /// # Errors
    /// There is no such field, or the value does not fit.
    fn set_parameter(&mut self, param_name: &str, param_val: &ParameterValue) -> Result<()>;

    /// Whether [`set_parameter`](Self::set_parameter) would set the field.
    ///
    /// # Errors
    /// There is no such field, or the value does not fit.
    fn check_parameter(&self, param_name: &str, param_val: &ParameterValue) -> Result<()>;
}

/// For the derive: the result for a field, with the field's name in the struct.
pub fn field<T>(result: Result<T>, prefix: &str) -> Result<T> {
    result.map_err(|error| match error {
        crate::Error::Parameter(error) => error.below(prefix).into(),
        other => other,
    })
}

/// For the derive: an error for a name that no field has.
pub fn no_field<T>() -> Result<T> {
    Err(ParameterError::NotDeclared { name: String::new() }.into())
}

/// A field that is one parameter.
macro_rules! leaf {
    ($type:ty, $variant:ident, $to:expr, $from:expr) => {
        impl RosParams for $type {
            fn register_parameters(
                &mut self,
                prefix: &str,
                param: Option<Parameter>,
                params: &mut IndexMap<String, Parameter>,
            ) -> Result<()> {
                let mut param = param.unwrap_or_default();
                if let Some(given) = params.get(prefix) {
                    if given.declared {
                        return Err(ParameterError::AlreadyDeclared { name: prefix.to_owned() }.into());
                    }
                    let given = given.value.clone().of_type(ParameterType::$variant);
                    field(self.set_parameter("", &given), prefix)?;
                    // Put in again below, in the order of the fields.
                    params.shift_remove(prefix);
                }
                param.value = self.get_parameter("")?;
                param.declared = true;
                params.insert(prefix.to_owned(), param);
                Ok(())
            }

            fn get_parameter(&mut self, param_name: &str) -> Result<ParameterValue> {
                match param_name {
                    "" => Ok(ParameterValue::$variant($to(self))),
                    _ => no_field(),
                }
            }

            fn set_parameter(&mut self, param_name: &str, param_val: &ParameterValue) -> Result<()> {
                self.check_parameter(param_name, param_val)?;
                if let ParameterValue::$variant(value) = param_val
                    && let Ok(value) = $from(value)
                {
                    *self = value;
                }
                Ok(())
            }

            fn check_parameter(&self, param_name: &str, param_val: &ParameterValue) -> Result<()> {
                match param_val {
                    _ if !param_name.is_empty() => no_field(),
                    ParameterValue::$variant(value) => match $from(value) {
                        Ok::<$type, _>(_) => Ok(()),
                        Err(reason) => Err(does_not_fit(param_val, reason)),
                    },
                    _ => Err(ParameterError::wrong_type("", ParameterType::$variant, param_val).into()),
                }
            }
        }
    };
}

fn does_not_fit(value: &ParameterValue, reason: impl Display) -> crate::Error {
    ParameterError::Conversion { name: String::new(), value: value.clone(), reason: reason.to_string() }
        .into()
}

fn same<T: Clone>(value: &T) -> Result<T, std::convert::Infallible> {
    Ok(value.clone())
}

fn to_integer<T: Into<i64> + Copy>(value: &T) -> i64 {
    (*value).into()
}

fn from_integer<T: TryFrom<i64>>(value: &i64) -> Result<T, T::Error> {
    T::try_from(*value)
}

leaf!(bool, Bool, Clone::clone, same);
leaf!(i8, Integer, to_integer, from_integer);
leaf!(i16, Integer, to_integer, from_integer);
leaf!(i32, Integer, to_integer, from_integer);
leaf!(i64, Integer, to_integer, same);
leaf!(u8, Integer, to_integer, from_integer);
leaf!(u16, Integer, to_integer, from_integer);
leaf!(u32, Integer, to_integer, from_integer);
leaf!(f64, Double, Clone::clone, same);
leaf!(f32, Double, |value: &f32| f64::from(*value), |value: &f64| same(&(*value as f32)));
leaf!(String, String, Clone::clone, same);
leaf!(Vec<bool>, BoolArray, Clone::clone, same);
leaf!(Vec<u8>, ByteArray, Clone::clone, same);
leaf!(Vec<i64>, IntegerArray, Clone::clone, same);
leaf!(Vec<f64>, DoubleArray, Clone::clone, same);
leaf!(Vec<String>, StringArray, Clone::clone, same);
