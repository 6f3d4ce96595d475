// SPDX-License-Identifier: MIT OR Apache-2.0

use super::value::{ParameterType, ParameterValue, UnknownParameterType};
use std::path::PathBuf;

/// Why a parameter was not declared, read or set.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum ParameterError {
    /// It was neither declared nor given a value.
    #[error("parameter '{name}' is not declared: declare it with `Node::declare_parameter`")]
    NotDeclared { name: String },
    /// It is already declared.
    #[error(
        "parameter '{name}' is declared already: declare it once, and use `Node::parameter` for further readers"
    )]
    AlreadyDeclared { name: String },
    /// An invalid name.
    #[error("'{name}' is not a parameter's name: {reason}")]
    InvalidName { name: String, reason: &'static str },
    /// The value has another type than the parameter.
    #[error("parameter '{name}' is of type {expected}, but {value} is of type {actual}{}", .hint.map(|hint| format!(": {hint}")).unwrap_or_default())]
    WrongType {
        name: String,
        expected: &'static str,
        actual: &'static str,
        value: ParameterValue,
        /// A hint what to write instead.
        hint: Option<&'static str>,
    },
    /// A text that is not a valid YAML value.
    #[error("'{text}' is not a parameter's value: {reason}")]
    InvalidValue { text: String, reason: String },
    /// A message contains an unknown type.
    #[error("parameter '{name}': {source}")]
    UnknownType { name: String, source: UnknownParameterType },
    /// A number does not fit the type of the struct's field.
    #[error("parameter '{name}': {value} does not fit: {reason}")]
    Conversion { name: String, value: ParameterValue, reason: String },
    /// The value is outside of the range of the descriptor.
    #[error("parameter '{name}': {value} is not in {range}")]
    OutOfRange { name: String, value: ParameterValue, range: String },
    /// It can be set only when it is declared.
    #[error("parameter '{name}' is read-only: give its value when the program starts (-p {name}:=VALUE)")]
    ReadOnly { name: String },
    /// A parameter of one type cannot be undeclared.
    #[error(
        "parameter '{name}' cannot be undeclared: it was declared with one type; declare it with `ParameterDescriptor::dynamic_typing`"
    )]
    StaticType { name: String },
    /// A callback refused the values.
    #[error("refused: {reason}")]
    Rejected { reason: String },
    /// A callback that checks parameters tried to set parameters.
    #[error(
        "parameter '{name}' cannot be changed by a callback that checks changes: do it after the change, when a reader has `changed`"
    )]
    InCallback { name: String },
    /// A parameter file that cannot be read or understood.
    #[error("parameter file {}: {reason}", path.display())]
    File {
        path: PathBuf,
        /// The error, with its line.
        reason: String,
    },
}

impl ParameterError {
    /// The same error for a field of the struct `prefix`.
    pub(crate) fn below(mut self, prefix: &str) -> ParameterError {
        if let ParameterError::NotDeclared { name }
        | ParameterError::WrongType { name, .. }
        | ParameterError::Conversion { name, .. } = &mut self
        {
            *name = match name.as_str() {
                "" => prefix.to_owned(),
                rest => format!("{prefix}.{rest}"),
            };
        }
        self
    }

    pub(crate) fn wrong_type(name: &str, expected: ParameterType, value: &ParameterValue) -> ParameterError {
        let hint = match (expected, value) {
            (ParameterType::Double, ParameterValue::Integer(_)) => Some("write a double with a point"),
            (ParameterType::String, _) => Some("quote a string"),
            _ => None,
        };
        let (name, value) = (name.to_owned(), value.clone());
        ParameterError::WrongType { name, expected: expected.name(), actual: value.type_name(), value, hint }
    }
}
