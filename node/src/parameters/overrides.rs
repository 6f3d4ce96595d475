// SPDX-License-Identifier: MIT OR Apache-2.0
//! The values that parameters are given from outside.

use super::parameter::Parameter;
use super::store::ParameterMap;
use crate::error::Result;
use crate::values::{ParameterValue, yaml};
use std::path::Path;

/// The values that the command line, parameter files and a node's options give the node of this name. Later ones count.
pub(crate) fn overrides(
    rules: &[(String, Vec<(String, ParameterValue)>)],
    own: &[(String, ParameterValue)],
    fully_qualified_name: &str,
) -> ParameterMap {
    let global = rules.iter().filter(|(pattern, _)| yaml::matches(pattern, fully_qualified_name));
    let all = global.flat_map(|(_, parameters)| parameters).chain(own);
    all.map(|(name, value)| (name.clone(), Parameter::new(value.clone()))).collect()
}

/// The parameter values of a ROS 2 parameter file for the node with this name, including `/**` and other wildcards. If there are
/// two values, the later one counts.
///
/// # Errors
/// [`Error::Parameter`](crate::Error::Parameter): it cannot be read, or is not a parameter file; the error
/// names the line.
pub fn parameters_of_file(path: &Path, fully_qualified_name: &str) -> Result<Vec<(String, ParameterValue)>> {
    let given = overrides(&yaml::read_parameter_file(path)?, &[], fully_qualified_name);
    Ok(given.into_iter().map(|(name, parameter)| (name, parameter.value)).collect())
}
