// SPDX-License-Identifier: MIT OR Apache-2.0
//! Values of parameters: their types, what is wrong with them, their forms in YAML and in messages.

mod error;
mod events;
#[cfg(feature = "rcl_interfaces")]
mod messages;
mod value;
pub(crate) mod yaml;

pub use error::ParameterError;
pub use value::{ParameterType, ParameterValue, ParameterVariant, UnknownParameterType, WrongParameterType};

pub(crate) use events::{Changes, EventTopic, ParameterEvents};
