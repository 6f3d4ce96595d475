// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut param`: reads and sets parameters of nodes through ROS 2's parameter services.

mod file;
mod value;

use crate::arguments::full_name;
use crate::call::{Caller, NodeCaller, no_response, nodes_serving};
use crate::completions;
use crate::verb::{CommonArgs, End, Failure, Outcome, Verbs};
use clap::{Args, Subcommand};
use serde_json::{Value, json};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline::rcl_interfaces::msg::{Parameter, ParameterDescriptor};
use tautline::rcl_interfaces::srv::{DescribeParameters, GetParameters, ListParameters, SetParameters};
use tautline::{ParameterType, ParameterValue, parameters_of_file};

/// The time limit for the answers of all nodes.
const PATIENCE_OF_ALL: Duration = Duration::from_secs(1);

const LIST: &str = "list_parameters";

#[derive(Args, Clone, Debug)]
pub struct NodeArg {
    /// The node's name with its namespace [default namespace: /]
    #[arg(value_name = "NODE", add = completions::nodes_with(LIST))]
    node: String,
}

/// Reads and sets the parameters of nodes.
///
/// Nodes of other hosts are visible if this host runs `taut gateway`. A node must answer within --timeout, by default 5 s.
#[derive(Subcommand, Clone, Debug)]
#[command(after_help = "Examples:
  taut param list                   of all nodes, in parallel; names those that do not answer
  taut param get /controller gain
  taut param set /controller gain 2.5
  taut param dump /controller > controller.yaml
  taut param load /controller controller.yaml

Exit codes: 0 done, 1 the answer is no, 2 the arguments cannot be used.")]
pub enum Verb {
    /// Prints the names of the parameters of one node or of all; exits with 1 if a node does not answer within 1 s
    List {
        /// The node's name with its namespace [default namespace: /]
        #[arg(value_name = "NODE", add = completions::nodes_with(LIST))]
        node: Option<String>,
    },
    /// Prints the value of a parameter
    Get {
        #[command(flatten)]
        node: NodeArg,
        /// The parameter
        #[arg(value_name = "NAME", add = completions::parameters())]
        name: String,
        /// Print the value alone
        #[arg(long)]
        hide_type: bool,
    },
    /// Sets a parameter; exits with 1 if the node refuses
    #[command(after_help = "Examples:
  taut param set /controller gain 2.5
  taut param set /controller frames '[map, odom]'
  taut param set /controller serial '!!str 0042'")]
    Set {
        #[command(flatten)]
        node: NodeArg,
        /// The parameter
        #[arg(value_name = "NAME", add = completions::parameters())]
        name: String,
        /// The value, read as YAML
        #[arg(value_name = "VALUE", allow_hyphen_values = true, value_parser = value)]
        value: ParameterValue,
    },
    /// Prints types, descriptions and ranges of parameters
    Describe {
        #[command(flatten)]
        node: NodeArg,
        /// The parameters [default: all]
        #[arg(value_name = "NAME", add = completions::parameters())]
        names: Vec<String>,
    },
    /// Deletes a parameter, if its node permits it
    Delete {
        #[command(flatten)]
        node: NodeArg,
        /// The parameter
        #[arg(value_name = "NAME", add = completions::parameters())]
        name: String,
    },
    /// Prints all parameters of a node as a ROS 2 parameter file
    Dump {
        #[command(flatten)]
        node: NodeArg,
    },
    /// Sets a node's parameters from a ROS 2 parameter file, wildcards included; exits with 1 if the node refuses one
    Load {
        #[command(flatten)]
        node: NodeArg,
        /// The file
        #[arg(value_name = "FILE")]
        file: PathBuf,
    },
}

fn value(text: &str) -> Result<ParameterValue, String> {
    text.parse().map_err(|error: tautline::ParameterError| error.to_string())
}

pub fn run(args: &Verbs<Verb>) -> Outcome {
    let common = &args.common;
    let find = |node: &str| NodeCaller::find(common, node, LIST, "does not serve its parameters");
    let node = |node: &NodeArg| find(&node.node);
    match &args.verb {
        Verb::List { node: None } => list_all(common),
        Verb::List { node: Some(name) } => {
            let names = find(name)?.names()?;
            if common.json {
                return print_json(&json!({ "node": full_name(name), "parameters": names }));
            }
            Ok(names.iter().try_for_each(|name| writeln!(crate::print::stdout(), "{name}"))?)
        }
        Verb::Get { node: of, name, hide_type } => {
            let mut node = node(of)?;
            let value = node.get(std::slice::from_ref(name))?.remove(0);
            if value == ParameterValue::NotSet {
                node.must_have(name)?;
            }
            let label = if *hide_type { String::new() } else { value::label(&value) };
            match common.json {
                true => print_json(&json!({
                    "node": node.name, "name": name, "type": value.type_name(), "value": value::to_json(&value),
                })),
                false => Ok(writeln!(crate::print::stdout(), "{label}{}", value::shown(&value))?),
            }
        }
        Verb::Set { node: of, name, value } => {
            let set = node(of)?.set_one(name, value)?;
            set.print(common, "Set parameter successful", "Setting parameter failed")
        }
        Verb::Delete { node: of, name } => {
            let set = node(of)?.set_one(name, &ParameterValue::NotSet)?;
            set.print(common, "Deleted parameter successfully", "Deleting parameter failed")
        }
        Verb::Describe { node: of, names } => describe(common, &mut node(of)?, names.clone()),
        Verb::Dump { node: of } => {
            let mut node = node(of)?;
            let names = node.names()?;
            let values = node.get(&names)?;
            let parameters: Vec<_> = names.into_iter().zip(values).collect();
            match common.json {
                true => print_json(&file::json(&node.name, &parameters)),
                false => Ok(write!(crate::print::stdout(), "{}", file::yaml(&node.name, &parameters))?),
            }
        }
        Verb::Load { node: of, file } => load(common, &mut node(of)?, file),
    }
}

fn print_json(json: &Value) -> Outcome {
    Ok(writeln!(crate::print::stdout(), "{json}")?)
}

fn list_all(common: &CommonArgs) -> Outcome {
    let (end, domain) = (End::within(PATIENCE_OF_ALL, common)?, common.domain()?);
    let nodes = nodes_serving(domain, LIST)?;
    let mut caller = Caller::new(domain, end)?;
    let all = ListParameters::Request::default;
    let requests = nodes.iter().map(|node| (format!("{node}/{LIST}"), all())).collect();
    let answers = caller.call_all::<ListParameters::Service>(requests)?;
    let (mut listed, mut silent, mut out) = (Vec::new(), 0, crate::print::stdout());
    for (node, answer) in nodes.iter().zip(answers) {
        let names = answer.map(|answer| sorted(answer.result.names));
        if let Err(error) = &names {
            silent += 1;
            eprintln!("taut: {node}: {}", no_response(error));
        }
        let names = names.ok();
        if common.json {
            listed.push(json!({ "node": node, "parameters": names }));
        } else if let Some(names) = names {
            writeln!(out, "{node}:")?;
            names.iter().try_for_each(|name| writeln!(out, "  {name}"))?;
        }
    }
    if common.json {
        writeln!(out, "{}", Value::from(listed))?;
    }
    match silent {
        0 => Ok(()),
        silent => Err(Failure::no(format!("{silent} of {} nodes did not answer", nodes.len()))),
    }
}

fn sorted(mut names: Vec<String>) -> Vec<String> {
    names.sort();
    names
}

fn describe(common: &CommonArgs, node: &mut NodeCaller, names: Vec<String>) -> Outcome {
    let names = if names.is_empty() { node.names()? } else { names };
    let request = DescribeParameters::Request { names: names.clone() };
    let mut told = node.call::<DescribeParameters::Service>("describe_parameters", request)?.descriptors;
    // Nodes of rclcpp return nothing for parameters that do not exist.
    told.resize_with(names.len(), ParameterDescriptor::default);
    for (name, told) in names.iter().zip(&told) {
        if told.type_ == ParameterType::NotSet as u8 {
            node.must_have(name)?;
        }
    }
    if common.json {
        return print_json(&told.iter().map(value::described_json).collect());
    }
    Ok(told.iter().try_for_each(|told| write!(crate::print::stdout(), "{}", value::described(told)))?)
}

fn load(common: &CommonArgs, node: &mut NodeCaller, file: &Path) -> Outcome {
    let parameters = parameters_of_file(file, &node.name)?;
    if parameters.is_empty() {
        let file = file.display();
        return Err(Failure::unusable(format!(
            "{file} says nothing for {}: neither by name nor as /**",
            node.name
        )));
    }
    let mut done = node.set(&parameters)?;
    // A read-only parameter may already have this value, as in a file that `dump` has written.
    let refused =
        |done: &[Set]| -> Vec<usize> { (0..done.len()).filter(|i| done[*i].refused.is_some()).collect() };
    let doubtful = refused(&done);
    let names: Vec<String> = doubtful.iter().map(|i| parameters[*i].0.clone()).collect();
    let now = node.get(&names)?;
    for (i, now) in doubtful.into_iter().zip(now) {
        if now == parameters[i].1 {
            done[i].refused = None;
        }
    }
    if common.json {
        print_json(&done.iter().map(Set::to_json).collect())?;
    } else {
        for Set { name, refused, .. } in &done {
            match refused {
                None => writeln!(crate::print::stdout(), "Set parameter {name} successful")?,
                Some(reason) => writeln!(crate::print::stdout(), "Set parameter {name} failed: {reason}")?,
            }
        }
    }
    match refused(&done).len() {
        0 => Ok(()),
        refused => Err(Failure::no(format!("{} refuses {refused} of {}", node.name, done.len()))),
    }
}

struct Set {
    node: String,
    name: String,
    refused: Option<String>,
}

impl Set {
    fn to_json(&self) -> Value {
        let successful = self.refused.is_none();
        json!({ "node": self.node, "name": self.name, "successful": successful, "reason": self.refused })
    }

    fn print(&self, common: &CommonArgs, done: &str, failed: &str) -> Outcome {
        if common.json {
            print_json(&self.to_json())?;
        } else if self.refused.is_none() {
            writeln!(crate::print::stdout(), "{done}")?;
        }
        match &self.refused {
            None => Ok(()),
            Some(reason) => Err(Failure::no(format!("{failed}: {reason}"))),
        }
    }
}

/// Requests of parameters.
impl NodeCaller {
    fn names(&mut self) -> Outcome<Vec<String>> {
        let listed = self.call::<ListParameters::Service>(LIST, ListParameters::Request::default())?;
        Ok(sorted(listed.result.names))
    }

    /// Parameters that do not exist have the value "not set".
    fn get(&mut self, names: &[String]) -> Outcome<Vec<ParameterValue>> {
        let request = GetParameters::Request { names: names.to_vec() };
        let values = self.call::<GetParameters::Service>("get_parameters", request)?.values;
        if values.len() == names.len() {
            return Ok(values.into_iter().map(ParameterValue::try_from).collect::<Result<_, _>>()?);
        }
        // If one parameter is missing, or is declared without a value, nodes of rclcpp return none of them.
        match names {
            [] | [_] => Ok(vec![ParameterValue::NotSet; names.len()]),
            _ => {
                let (first, rest) = names.split_at(names.len() / 2);
                Ok([self.get(first)?, self.get(rest)?].concat())
            }
        }
    }

    fn set(&mut self, parameters: &[(String, ParameterValue)]) -> Outcome<Vec<Set>> {
        let message =
            |(name, value): &(String, ParameterValue)| Parameter { name: name.clone(), value: value.into() };
        let request = SetParameters::Request { parameters: parameters.iter().map(message).collect() };
        let results = self.call::<SetParameters::Service>("set_parameters", request)?.results;
        let mut results = results.into_iter();
        let set = parameters.iter().map(|(name, _)| Set {
            node: self.name.clone(),
            name: name.clone(),
            refused: match results.next() {
                Some(result) => (!result.successful).then_some(result.reason),
                None => Some("the node does not say whether it was set".to_owned()),
            },
        });
        Ok(set.collect())
    }

    fn set_one(&mut self, name: &str, value: &ParameterValue) -> Outcome<Set> {
        let set = self.set(&[(name.to_owned(), value.clone())])?.remove(0);
        if set.refused.is_some() {
            self.must_have(name)?;
        }
        Ok(set)
    }

    /// Fails if the node has no parameter of this name; the error suggests the nearest name.
    fn must_have(&mut self, name: &str) -> Outcome {
        let names = self.names()?;
        if names.iter().any(|there| there == name) {
            return Ok(());
        }
        let (what, list) = (format!("parameter of {}", self.name), format!("param list {}", self.name));
        Err(Failure::unknown(&what, name, names.iter().map(String::as_str), &list))
    }
}
