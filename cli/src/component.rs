// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut component`: nodes in shared libraries, in a container that runs them in one process.

use crate::arguments::full_name;
use crate::call::{Caller, MANAGER};
use crate::completions;
use crate::log::{LEVELS, severity};
use crate::sibling::Sibling;
use crate::verb::{CommonArgs, End, Failure, Outcome};
use clap::{Args, Subcommand, ValueHint};
use serde_json::json;
use std::ffi::OsString;
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Duration;
use tautline::composition_interfaces::srv::{ListNodes, LoadNode, UnloadNode};
use tautline::rcl_interfaces::msg;
use tautline::{LogSeverity, ParameterValue};
use tautline_msgs::Service;

const CONTAINER: Sibling = Sibling {
    program: "taut-container",
    // `cargo install` does not work: it leaves out the library that the container shares with components.
    build: "build it together with your components, as docs/composition.md says: \
            `cargo build --release -p taut -p tautline-container -p YOUR_COMPONENTS`",
};

/// The time limit for loading: creating a component may open topics and start threads.
const PATIENCE: Duration = Duration::from_secs(10);

/// Runs components from shared libraries in one process; loads and unloads them while it runs.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  taut component run libdemo.so:demo::Counter
  taut component load libdemo.so:demo::Doubler --namespace /robot
  taut component load libdemo.so:demo::Counter -p step:=2 -r count:=/count --log-level debug
  taut component list
  taut component unload 2")]
pub struct ComponentArgs {
    #[command(subcommand)]
    verb: Verb,
    #[command(flatten)]
    target: Target,
}

#[derive(Args, Debug)]
struct Target {
    /// The container's node [default: /ComponentManager]
    #[arg(long, global = true, value_name = "NODE", add = completions::nodes_with("_container/list_nodes"))]
    container: Option<String>,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Subcommand, Debug)]
enum Verb {
    /// Runs taut-container, from the folder of this program or from PATH; its options: taut component run --help
    #[command(disable_help_flag = true)]
    Run {
        /// The container's options
        #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "OPTIONS")]
        arguments: Vec<OsString>,
    },
    /// Loads a component into a container that runs, and prints its number and its node
    Load {
        /// A library, or LIBRARY:COMPONENT if it has several
        #[arg(value_name = "LIBRARY[:COMPONENT]", value_hint = ValueHint::FilePath)]
        what: String,
        /// The node's name; otherwise the last part of the component's, in lower case
        #[arg(long, default_value = "")]
        name: String,
        /// The node's namespace
        #[arg(long, default_value = "")]
        namespace: String,
        /// A remapping rule, FROM:=TO; may be given several times
        #[arg(long, short = 'r', value_name = "RULE")]
        remap: Vec<String>,
        /// A parameter's value, NAME:=VALUE, read as YAML; may be given several times
        #[arg(long = "param", short = 'p', value_name = "NAME:=VALUE", value_parser = parameter)]
        params: Vec<msg::Parameter>,
        /// The level of the node's logger
        #[arg(long, value_name = "LEVEL", value_parser = severity(&LEVELS[1..]), ignore_case = true)]
        log_level: Option<LogSeverity>,
        /// An extra argument as for ROS 2's containers, NAME:=VALUE: use_intra_process_comms or forward_global_arguments
        #[arg(long, short = 'e', value_name = "NAME:=VALUE", value_parser = parameter)]
        extra_argument: Vec<msg::Parameter>,
    },
    /// Unloads a component: its callbacks end. Prints nothing, with --json its number
    Unload {
        /// Its number, as `load` and `list` print it
        #[arg(add = completions::components())]
        id: u64,
    },
    /// Prints the components of a container
    List,
}

/// Runs the verb. `run` returns only if the container cannot be started.
pub fn run(args: ComponentArgs) -> Outcome {
    let ComponentArgs { verb, target } = args;
    match verb {
        Verb::Run { mut arguments } => {
            let Target { container, common } = &target;
            if container.is_some() || common.json || common.timeout().is_some() {
                let no = "`taut component run` starts a container and has none of --container, --json and --timeout: leave them out; \
                          `taut component run --help` shows its options";
                return Err(Failure::unusable(no));
            }
            if common.is_domain_named() {
                arguments.splice(..0, ["--domain".into(), common.domain()?.to_string().into()]);
            }
            return Err(CONTAINER.become_it(&arguments));
        }
        Verb::Load { what, name, namespace, remap, params, log_level, extra_argument } => {
            let (library, component) = what.split_once(':').unwrap_or((&what, ""));
            // The container may run in another folder, so the library's path must be absolute.
            let library = std::path::absolute(library).unwrap_or_else(|_| PathBuf::from(library));
            let request = LoadNode::Request {
                package_name: library.to_string_lossy().into_owned(),
                plugin_name: component.into(),
                node_name: name,
                node_namespace: namespace,
                remap_rules: remap,
                log_level: log_level.map_or(0, |level| level as u8),
                parameters: params,
                extra_arguments: extra_argument,
            };
            let loaded = call::<LoadNode::Service>(&target, "load_node", request)?;
            if !loaded.success {
                return Err(Failure::no(loaded.error_message));
            }
            print(&target, &[(loaded.unique_id, loaded.full_node_name)])?;
        }
        Verb::Unload { id } => {
            let request = UnloadNode::Request { unique_id: id };
            let unloaded = call::<UnloadNode::Service>(&target, "unload_node", request)?;
            if !unloaded.success {
                return Err(Failure::no(unloaded.error_message));
            }
            if target.common.json {
                writeln!(crate::print::stdout(), "{}", json!([{ "id": id }]))?;
            }
        }
        Verb::List => {
            let listed = call::<ListNodes::Service>(&target, "list_nodes", ListNodes::Request::default())?;
            let rows: Vec<_> = listed.unique_ids.into_iter().zip(listed.full_node_names).collect();
            print(&target, &rows)?;
        }
    }
    Ok(())
}

/// Parses a parameter as ROS 2's option `-p` does, for one node.
fn parameter(rule: &str) -> Result<msg::Parameter, String> {
    match rule.split_once(":=") {
        Some((name, value)) if !name.is_empty() => {
            let value = value.parse::<ParameterValue>().map_err(|error| error.to_string())?;
            Ok(msg::Parameter { name: name.to_owned(), value: (&value).into() })
        }
        _ => Err("it has no name before ':='".into()),
    }
}

fn call<T: Service>(target: &Target, service: &str, request: T::Request) -> Outcome<T::Response> {
    let container = target.container.as_deref().unwrap_or(MANAGER);
    let (end, domain) = (End::within(PATIENCE, &target.common)?, target.common.domain()?);
    let request = (format!("{}/_container/{service}", full_name(container)), request);
    let answer = Caller::new(domain, end)?.call_all::<T>(vec![request])?.remove(0);
    answer.map_err(|source| {
        Failure::no(match source {
            tautline::Error::ServiceTimeout { timeout, .. } => format!(
                "{container} has not answered within {timeout:?}: it may still be busy; `taut component \
                 list` shows the result later"
            ),
            source => format!(
                "{container} does not answer: {source}; `taut component run` starts a container, `taut node list` prints which \
                 nodes there are"
            ),
        })
    })
}

fn print(target: &Target, rows: &[(u64, String)]) -> io::Result<()> {
    let mut out = crate::print::stdout();
    if target.common.json {
        let rows = rows.iter().map(|(id, node)| json!({ "id": id, "node": node }));
        return writeln!(out, "{}", serde_json::Value::from_iter(rows));
    }
    rows.iter().try_for_each(|(id, node)| writeln!(out, "{id} {node}"))
}
