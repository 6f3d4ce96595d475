// SPDX-License-Identifier: MIT OR Apache-2.0
//! The responses of a node's parameter services.

use super::descriptor::{ParameterDescriptor, ParameterRange};
use super::store::Parameters;
use crate::error::Result;
use crate::values::{ParameterError, ParameterType, ParameterValue};
use tautline_ros_msgs::rcl_interfaces::msg::{self, ListParametersResult, SetParametersResult};
use tautline_ros_msgs::rcl_interfaces::srv::{
    DescribeParameters, GetParameterTypes, GetParameters, ListParameters, SetParameters,
    SetParametersAtomically,
};

/// `list_parameters`: any depth.
const DEPTH_RECURSIVE: u64 = 0;
const SEPARATOR: char = '.';

/// The parameters with a new value, for the stream of changes.
pub(crate) type Changed = Vec<(String, ParameterValue)>;

/// The values of parameters; "not set" for a parameter that does not exist.
pub(crate) fn get(parameters: &Parameters, request: &GetParameters::Request) -> GetParameters::Response {
    let values = parameters.values(&request.names);
    GetParameters::Response { values: values.iter().map(Into::into).collect() }
}

/// The types of parameters; "not set" for a parameter that does not exist.
pub(crate) fn get_types(
    parameters: &Parameters,
    request: &GetParameterTypes::Request,
) -> GetParameterTypes::Response {
    let values = parameters.values(&request.names);
    GetParameterTypes::Response { types: values.iter().map(|value| value.parameter_type() as u8).collect() }
}

/// Describes parameters; for a parameter that does not exist, only the name.
pub(crate) fn describe(
    parameters: &Parameters,
    request: &DescribeParameters::Request,
) -> DescribeParameters::Response {
    let describe = |name: &String| {
        let (parameter_type, of) = parameters.describe(name).unwrap_or_default();
        descriptor(name, parameter_type, &of)
    };
    DescribeParameters::Response { descriptors: request.names.iter().map(describe).collect() }
}

/// Lists the parameters that equal a prefix or are up to `depth` names below one; without prefixes, all of up to `depth` names.
pub(crate) fn list(parameters: &Parameters, request: &ListParameters::Request) -> ListParameters::Response {
    let shallow = |rest: &str| {
        request.depth == DEPTH_RECURSIVE || (rest.matches(SEPARATOR).count() as u64) < request.depth
    };
    let wanted = |name: &str| {
        let below = |prefix: &String| match name.strip_prefix(prefix.as_str()) {
            Some(rest) => rest.is_empty() || rest.strip_prefix(SEPARATOR).is_some_and(shallow),
            None => false,
        };
        request.prefixes.iter().any(below) || request.prefixes.is_empty() && shallow(name)
    };
    let names: Vec<String> = parameters.names().into_iter().filter(|name| wanted(name)).collect();
    let mut prefixes: Vec<String> = Vec::new();
    for (prefix, _) in names.iter().filter_map(|name| name.rsplit_once(SEPARATOR)) {
        if !prefixes.iter().any(|other| other == prefix) {
            prefixes.push(prefix.to_owned());
        }
    }
    ListParameters::Response { result: ListParametersResult { names, prefixes } }
}

/// Sets parameters one after the other: a refused one does not stop the following ones.
pub(crate) fn set(
    parameters: &Parameters,
    request: SetParameters::Request,
) -> (SetParameters::Response, Changed) {
    let mut changed = Changed::new();
    let results = request.parameters.into_iter().map(|parameter| {
        let set = values([parameter]).and_then(|values| parameters.change(values));
        result(set, &mut changed)
    });
    (SetParameters::Response { results: results.collect() }, changed)
}

/// Sets all parameters or none.
pub(crate) fn set_atomically(
    parameters: &Parameters,
    request: SetParametersAtomically::Request,
) -> (SetParametersAtomically::Response, Changed) {
    let mut changed = Changed::new();
    let set = values(request.parameters).and_then(|values| parameters.change(values));
    (SetParametersAtomically::Response { result: result(set, &mut changed) }, changed)
}

fn result(set: Result<Changed>, changed: &mut Changed) -> SetParametersResult {
    match set {
        Ok(values) => {
            changed.extend(values);
            SetParametersResult { successful: true, reason: String::new() }
        }
        Err(error) => SetParametersResult { successful: false, reason: error.to_string() },
    }
}

fn values(parameters: impl IntoIterator<Item = msg::Parameter>) -> Result<Changed> {
    let of_message = |msg::Parameter { name, value }| match value.try_into() {
        Ok(value) => Ok((name, value)),
        Err(source) => Err(ParameterError::UnknownType { name, source }.into()),
    };
    parameters.into_iter().map(of_message).collect()
}

fn descriptor(
    name: &str,
    parameter_type: ParameterType,
    of: &ParameterDescriptor,
) -> msg::ParameterDescriptor {
    let mut message = msg::ParameterDescriptor {
        name: name.to_owned(),
        type_: parameter_type as u8,
        description: of.description.clone(),
        additional_constraints: of.additional_constraints.clone(),
        read_only: of.read_only,
        dynamic_typing: of.dynamic_typing,
        ..Default::default()
    };
    match of.range {
        Some(ParameterRange::Integer { from, to, step }) => {
            message.integer_range.push(msg::IntegerRange { from_value: from, to_value: to, step });
        }
        Some(ParameterRange::Double { from, to, step }) => {
            message.floating_point_range.push(msg::FloatingPointRange {
                from_value: from,
                to_value: to,
                step,
            });
        }
        None => {}
    }
    message
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parameters::store::ParameterMap;
    use crate::values::ParameterEvents;

    fn parameters() -> Parameters {
        let parameters = Parameters::new(ParameterMap::new(), ParameterEvents::nowhere());
        let gain = ParameterDescriptor::new().description("of the controller").range(0.0..=2.0).step(0.5);
        parameters.declare("gain", 1.0, gain).unwrap();
        parameters.declare("arm.speed", 3, ParameterDescriptor::new().range(0..=9)).unwrap();
        parameters
            .declare("arm.tool.name", "saw".to_owned(), ParameterDescriptor::new().read_only())
            .unwrap();
        parameters
    }

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).into()).collect()
    }

    fn message(name: &str, value: impl Into<ParameterValue>) -> msg::Parameter {
        msg::Parameter { name: name.into(), value: (&value.into()).into() }
    }

    #[test]
    fn values_types_and_descriptors_are_told() {
        let parameters = parameters();
        let names = names(&["arm.speed", "nothing", "gain"]);
        let values = get(&parameters, &GetParameters::Request { names: names.clone() }).values;
        assert_eq!((values[0].integer_value, values[1].type_, values[2].double_value), (3, 0, 1.0));
        let types = get_types(&parameters, &GetParameterTypes::Request { names: names.clone() }).types;
        assert_eq!(types, [2, 0, 3]);
        let descriptors = describe(&parameters, &DescribeParameters::Request { names }).descriptors;
        assert_eq!((descriptors[1].name.as_str(), descriptors[1].type_), ("nothing", 0));
        let gain = &descriptors[2];
        assert_eq!((gain.description.as_str(), gain.read_only), ("of the controller", false));
        let range = &gain.floating_point_range[0];
        assert_eq!((range.from_value, range.to_value, range.step), (0.0, 2.0, 0.5));
        assert_eq!(descriptors[0].integer_range[0].to_value, 9);
    }

    #[test]
    fn names_are_listed_by_prefix_and_depth() {
        let parameters = parameters();
        let all = ["gain", "arm.speed", "arm.tool.name"];
        for (prefixes, depth, expected, parents) in [
            (&[][..], 0, &all[..], &["arm", "arm.tool"][..]),
            (&[], 1, &all[..1], &[]),
            (&[], 2, &all[..2], &["arm"]),
            (&["arm"], 0, &all[1..], &["arm", "arm.tool"]),
            (&["arm"], 1, &all[1..2], &["arm"]),
            (&["arm.tool", "gain"], 1, &["gain", "arm.tool.name"], &["arm.tool"]),
            (&["ar"], 0, &[], &[]),
        ] {
            let request = ListParameters::Request { prefixes: names(prefixes), depth };
            let result = list(&parameters, &request).result;
            assert_eq!(
                (result.names, result.prefixes),
                (names(expected), names(parents)),
                "{prefixes:?} {depth}"
            );
        }
    }

    #[test]
    fn each_is_set_or_refused_with_the_reason() {
        let parameters = parameters();
        let mut unknown = message("gain", 1.0);
        unknown.value.type_ = 12;
        let request = SetParameters::Request {
            parameters: vec![
                message("gain", 1.5),
                message("gain", 3.0),
                message("gain", "fast"),
                message("arm.tool.name", "drill"),
                message("other", 1),
                unknown,
                message("arm.speed", 3),
            ],
        };
        let (response, changed) = set(&parameters, request);
        let reasons: Vec<_> = response.results.iter().map(|result| result.reason.as_str()).collect();
        for (reason, expected) in reasons.iter().zip([
            "",
            "parameter 'gain': 3.0 is not in 0.0..=2.0 in steps of 0.5",
            "parameter 'gain' is of type double, but fast is of type string",
            "parameter 'arm.tool.name' is read-only: give its value when the program starts",
            "parameter 'other' is not declared",
            "parameter 'gain': 12 is not a type of parameters",
            "",
        ]) {
            assert!(reason.starts_with(expected) && reason.is_empty() == expected.is_empty(), "{reason}");
        }
        assert!(response.results.iter().all(|result| result.successful == result.reason.is_empty()));
        // To what it was before is no change.
        assert_eq!(changed, [("gain".to_owned(), ParameterValue::Double(1.5))]);
    }

    #[test]
    fn all_are_set_or_none() {
        let parameters = parameters();
        let attempt = |speed: i64| {
            let request = SetParametersAtomically::Request {
                parameters: vec![message("gain", 0.5), message("arm.speed", speed)],
            };
            set_atomically(&parameters, request)
        };
        let (response, changed) = attempt(10);
        assert_eq!(response.result.reason, "parameter 'arm.speed': 10 is not in 0..=9");
        assert!(changed.is_empty() && !response.result.successful);
        assert_eq!(parameters.get::<f64>("gain").unwrap(), 1.0);
        let (response, changed) = attempt(9);
        assert!(response.result.successful && changed.len() == 2);
        assert_eq!(
            (parameters.get::<f64>("gain").unwrap(), parameters.get::<i64>("arm.speed").unwrap()),
            (0.5, 9)
        );
    }
}
