// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parameter values in the form of `rcl_interfaces`.

use super::value::{ParameterValue, UnknownParameterType};
use tautline_ros_msgs::rcl_interfaces::msg;

impl From<&ParameterValue> for msg::ParameterValue {
    fn from(value: &ParameterValue) -> msg::ParameterValue {
        let mut message = msg::ParameterValue { type_: value.parameter_type() as u8, ..Default::default() };
        match value.clone() {
            ParameterValue::NotSet => {}
            ParameterValue::Bool(value) => message.bool_value = value,
            ParameterValue::Integer(value) => message.integer_value = value,
            ParameterValue::Double(value) => message.double_value = value,
            ParameterValue::String(value) => message.string_value = value,
            ParameterValue::BoolArray(values) => message.bool_array_value = values,
            ParameterValue::ByteArray(values) => message.byte_array_value = values,
            ParameterValue::IntegerArray(values) => message.integer_array_value = values,
            ParameterValue::DoubleArray(values) => message.double_array_value = values,
            ParameterValue::StringArray(values) => message.string_array_value = values,
        }
        message
    }
}

impl TryFrom<msg::ParameterValue> for ParameterValue {
    type Error = UnknownParameterType;

    fn try_from(value: msg::ParameterValue) -> Result<ParameterValue, UnknownParameterType> {
        Ok(match value.type_ {
            0 => ParameterValue::NotSet,
            1 => ParameterValue::Bool(value.bool_value),
            2 => ParameterValue::Integer(value.integer_value),
            3 => ParameterValue::Double(value.double_value),
            4 => ParameterValue::String(value.string_value),
            5 => ParameterValue::ByteArray(value.byte_array_value),
            6 => ParameterValue::BoolArray(value.bool_array_value),
            7 => ParameterValue::IntegerArray(value.integer_array_value),
            8 => ParameterValue::DoubleArray(value.double_array_value),
            9 => ParameterValue::StringArray(value.string_array_value),
            number => return Err(UnknownParameterType { number }),
        })
    }
}
