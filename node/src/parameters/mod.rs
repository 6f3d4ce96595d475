// SPDX-License-Identifier: MIT OR Apache-2.0
//! Parameters: declared by a node, given on the command line or in files, set from other threads and nodes.

mod descriptor;
mod overrides;
mod parameter;
mod reader;
mod ros_params;
#[cfg(feature = "rcl_interfaces")]
pub(crate) mod services;
mod store;

pub use descriptor::{ParameterDescriptor, ParameterRange};
pub use overrides::parameters_of_file;
pub use parameter::Parameter;
pub use reader::ParameterReader;
pub use ros_params::{RosParams, field, no_field};
pub use store::{OnSetParameters, Parameters};

pub(crate) use overrides::overrides;
