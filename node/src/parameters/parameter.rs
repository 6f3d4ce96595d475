// SPDX-License-Identifier: MIT OR Apache-2.0
//! A parameter as the node keeps it.

use super::descriptor::ParameterDescriptor;
use crate::values::{ParameterError, ParameterValue};

/// A parameter of a node.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Parameter {
    /// Its value.
    pub value: ParameterValue,
    /// Its description.
    pub descriptor: ParameterDescriptor,
    /// If false, the value was given on the command line, or inserted directly: then nothing is checked.
    pub(crate) declared: bool,
}

impl Parameter {
    /// A parameter with a value and an empty description.
    pub fn new(value: ParameterValue) -> Parameter {
        Parameter { value, ..Parameter::default() }
    }

    /// A parameter without a value.
    pub fn empty() -> Parameter {
        Parameter::default()
    }

    /// A parameter without a value yet, for [`RosParams::register_parameters`](super::RosParams::register_parameters).
    pub fn with_descriptor(descriptor: ParameterDescriptor) -> Parameter {
        Parameter { descriptor, ..Parameter::default() }
    }

    /// Whether it may be set to `value`.
    pub(super) fn check(&self, name: &str, value: &ParameterValue) -> Result<(), ParameterError> {
        if !self.declared {
            return Ok(());
        }
        if self.descriptor.read_only {
            return Err(ParameterError::ReadOnly { name: name.to_owned() });
        }
        if *value == ParameterValue::NotSet
            && self.value != ParameterValue::NotSet
            && !self.descriptor.dynamic_typing
        {
            return Err(ParameterError::StaticType { name: name.to_owned() });
        }
        let same = self.value.parameter_type() == value.parameter_type();
        if !same && !self.descriptor.dynamic_typing && self.value != ParameterValue::NotSet {
            return Err(ParameterError::wrong_type(name, self.value.parameter_type(), value));
        }
        self.descriptor.check(name, value)
    }

    /// As in ROS 2, setting a parameter to "not set" undeclares it.
    pub(super) fn is_ended_by(&self, value: &ParameterValue) -> bool {
        *value == ParameterValue::NotSet && self.value != ParameterValue::NotSet
    }
}
