// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node's functions for its parameters.

use super::Node;
use crate::error::Result;
use crate::parameters::{ParameterDescriptor, ParameterReader, Parameters};
use crate::values::{ParameterValue, ParameterVariant, WrongParameterType};

impl Node {
    /// Declares a parameter: it starts with the value from the command line or a parameter file, else with `default`. The
    /// parameter has the type of `default`.
    ///
    /// # Real-time
    /// Setup only; reading the [`ParameterReader`] is wait-free.
    ///
    /// # Errors
    /// [`Error::Parameter`](crate::Error::Parameter): already declared; a given value is of another type.
    pub fn declare_parameter<T: ParameterVariant>(
        &mut self,
        name: &str,
        default: T,
    ) -> Result<ParameterReader<T>> {
        self.declare_parameter_with(name, default, ParameterDescriptor::new())
    }

    /// Like [`declare_parameter`](Self::declare_parameter), with a description, a range and so on.
    ///
    /// # Errors
    /// As [`declare_parameter`](Self::declare_parameter); a given value is out of range.
    pub fn declare_parameter_with<T: ParameterVariant>(
        &mut self,
        name: &str,
        default: T,
        descriptor: ParameterDescriptor,
    ) -> Result<ParameterReader<T>> {
        self.parameters.declare(name, default, descriptor)
    }

    /// A parameter's value, declared or given. An `Option` is `None` if there is none.
    ///
    /// # Errors
    /// [`Error::Parameter`](crate::Error::Parameter): there is none, or it is of another type.
    pub fn get_parameter<T>(&self, name: &str) -> Result<T>
    where
        ParameterValue: TryInto<T, Error = WrongParameterType>,
    {
        self.parameters.get(name)
    }

    /// Sets a parameter: see [`Parameters::set`].
    ///
    /// # Errors
    /// [`Error::Parameter`](crate::Error::Parameter): not declared, another type, out of range, read-only, refused.
    pub fn set_parameter(&self, name: &str, value: impl Into<ParameterValue>) -> Result<()> {
        self.parameters.set(name, value)
    }

    /// A reader of a parameter that was declared or given a value. As a stream it yields the parameter's
    /// changes.
    ///
    /// # Real-time
    /// Setup only; reading is wait-free.
    ///
    /// # Errors
    /// [`Error::Parameter`](crate::Error::Parameter): there is none, or it is of another type.
    pub fn parameter<T: ParameterVariant>(&self, name: &str) -> Result<ParameterReader<T>> {
        self.parameters.reader(name)
    }

    /// The node's parameters, for any thread.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }
}
