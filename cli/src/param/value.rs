// SPDX-License-Identifier: MIT OR Apache-2.0
//! Values and descriptions of parameters as ROS 2's tools print them.

use serde_json::{Value, json};
use tautline::ParameterValue;
use tautline::rcl_interfaces::msg::ParameterDescriptor;

/// The text before a value, such as `Double value is: `.
pub fn label(value: &ParameterValue) -> String {
    let kind = value.type_name();
    let kind = format!("{}{}", kind[..1].to_uppercase(), &kind[1..]);
    match (kind.strip_suffix(" array"), value) {
        (_, ParameterValue::NotSet) => String::new(),
        (Some(items), _) => format!("{items} values are: "),
        (None, _) => format!("{kind} value is: "),
    }
}

pub fn shown(value: &ParameterValue) -> String {
    match value {
        ParameterValue::NotSet => "Parameter not set.".into(),
        ParameterValue::Bool(true) => "True".into(),
        ParameterValue::Bool(false) => "False".into(),
        value => value.to_string(),
    }
}

pub fn to_json(value: &ParameterValue) -> Value {
    match value {
        ParameterValue::NotSet => Value::Null,
        ParameterValue::Bool(value) => json!(value),
        ParameterValue::Integer(value) => json!(value),
        ParameterValue::Double(value) => json!(value),
        ParameterValue::String(value) => json!(value),
        ParameterValue::BoolArray(values) => json!(values),
        ParameterValue::ByteArray(values) => json!(values),
        ParameterValue::IntegerArray(values) => json!(values),
        ParameterValue::DoubleArray(values) => json!(values),
        ParameterValue::StringArray(values) => json!(values),
    }
}

fn type_name(number: u8) -> &'static str {
    let message = tautline::rcl_interfaces::msg::ParameterValue { type_: number, ..Default::default() };
    ParameterValue::try_from(message).map_or("unknown", |value| value.type_name())
}

/// The description in the format of `ros2 param describe`.
pub fn described(told: &ParameterDescriptor) -> String {
    let mut constraints = Vec::new();
    let mut constrain = |what: &str, value: String| constraints.push(format!("    {what}: {value}\n"));
    if told.read_only {
        constrain("Read only", "true".into());
    }
    for range in &told.integer_range {
        constrain("Min value", range.from_value.to_string());
        constrain("Max value", range.to_value.to_string());
        constrain("Step", range.step.to_string());
    }
    for range in &told.floating_point_range {
        constrain("Min value", ParameterValue::Double(range.from_value).to_string());
        constrain("Max value", ParameterValue::Double(range.to_value).to_string());
        constrain("Step", ParameterValue::Double(range.step).to_string());
    }
    if !told.additional_constraints.is_empty() {
        constrain("Additional constraints", told.additional_constraints.clone());
    }
    let mut text = format!("Parameter name: {}\n  Type: {}\n", told.name, type_name(told.type_));
    if !told.description.is_empty() {
        text += &format!("  Description: {}\n", told.description);
    }
    if !constraints.is_empty() {
        text += &format!("  Constraints:\n{}", constraints.concat());
    }
    text
}

pub fn described_json(told: &ParameterDescriptor) -> Value {
    let mut json = json!(told);
    json["type"] = json!(type_name(told.type_));
    json
}
