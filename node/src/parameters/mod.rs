// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parameters: declared by a node, given on the command line or in files, set from other threads and nodes.

mod descriptor;
mod error;
mod events;
#[cfg(feature = "rcl_interfaces")]
mod handler;
#[cfg(feature = "rcl_interfaces")]
mod messages;
mod node;
mod parameter;
mod reader;
mod ros_params;
#[cfg(feature = "rcl_interfaces")]
mod services;
mod store;
mod value;
pub(crate) mod yaml;

pub use descriptor::{ParameterDescriptor, ParameterRange};
pub use error::ParameterError;
pub use node::parameters_of_file;
pub use parameter::Parameter;
pub use reader::ParameterReader;
pub use ros_params::{RosParams, field, no_field};
pub use store::{OnSetParameters, Parameters};
pub use value::{ParameterType, ParameterValue, ParameterVariant, UnknownParameterType, WrongParameterType};

pub(crate) use events::{EventTopic, ParameterEvents};
pub(crate) use node::{overrides, read_parameter_file};
pub(crate) use store::ParameterMap;
