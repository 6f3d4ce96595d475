// SPDX-License-Identifier: MIT OR Apache-2.0
//! The services of a container, as in ROS 2: loading, unloading and listing components.

use crate::container::{Container, Load};
use futures::StreamExt;
use std::future::{Future, ready};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tautline::composition_interfaces::srv::{ListNodes, LoadNode, UnloadNode};
use tautline::rcl_interfaces::msg;
use tautline::{LogSeverity, Node, ParameterValue, Qos, RemapRules};

/// A container that several threads share.
pub type SharedContainer = Arc<Mutex<Container>>;

/// Offers `~/_container/load_node`, `unload_node` and `list_nodes` of `node`. They respond as long as the future is polled; it
/// never ends. Its thread creates components, and waits for their ends.
///
/// A request's `package_name` is the path of a library, its `plugin_name` the component. The rest is as in rclcpp's containers: the
/// node's name, namespace, remapping rules, parameters and log level, and the extra arguments `use_intra_process_comms` and
/// `forward_global_arguments`.
///
/// # Errors
/// [`tautline::Error::Transport`] if a service cannot be created.
pub fn serve(
    container: &SharedContainer,
    node: &mut Node,
) -> tautline::Result<impl Future<Output = ()> + Send + use<>> {
    let qos = Qos::services_default();
    let loads = node.create_service::<LoadNode::Service>("~/_container/load_node", qos)?.owned();
    let unloads = node.create_service::<UnloadNode::Service>("~/_container/unload_node", qos)?.owned();
    let lists = node.create_service::<ListNodes::Service>("~/_container/list_nodes", qos)?.owned();
    let container = container.clone();
    Ok(async move {
        // An error of `respond` means that the client has ended.
        let loads = loads.for_each(|request| {
            let response = load(&mut lock(&container), &request.message);
            let _ = request.respond(response);
            ready(())
        });
        let unloads = unloads.for_each(|request| {
            let response = unload(&mut lock(&container), &request.message);
            let _ = request.respond(response);
            ready(())
        });
        let lists = lists.for_each(|request| {
            let response = list(&lock(&container));
            let _ = request.respond(response);
            ready(())
        });
        futures::join!(loads, unloads, lists);
    })
}

fn lock(container: &SharedContainer) -> MutexGuard<'_, Container> {
    container.lock().unwrap_or_else(PoisonError::into_inner)
}

fn load(container: &mut Container, request: &LoadNode::Request) -> LoadNode::Response {
    let loaded = described(request).and_then(|load| container.load(&load).map_err(|error| error.to_string()));
    match loaded {
        Ok(unique_id) => LoadNode::Response {
            success: true,
            full_node_name: container.full_name(unique_id).unwrap_or_default().into(),
            unique_id,
            ..Default::default()
        },
        Err(error_message) => LoadNode::Response { error_message, ..Default::default() },
    }
}

/// The component that a request describes.
fn described(request: &LoadNode::Request) -> Result<Load, String> {
    let remap = RemapRules::parse(&request.remap_rules).map_err(|error| error.to_string())?;
    Ok(Load {
        library: request.package_name.clone().into(),
        component: request.plugin_name.clone(),
        name: request.node_name.clone(),
        namespace: request.node_namespace.clone(),
        remap,
        parameters: parameters("parameter", &request.parameters)?,
        log_level: log_level(request.log_level)?,
        use_global_arguments: forward_global_arguments(&request.extra_arguments)?,
    })
}

fn parameters(kind: &str, messages: &[msg::Parameter]) -> Result<Vec<(String, ParameterValue)>, String> {
    let read = |msg::Parameter { name, value }: &msg::Parameter| match ParameterValue::try_from(value.clone())
    {
        Ok(value) => Ok((name.clone(), value)),
        Err(error) => Err(format!("{kind} '{name}': {error}")),
    };
    messages.iter().map(read).collect()
}

fn log_level(level: u8) -> Result<Option<LogSeverity>, String> {
    use LogSeverity::{Debug, Error, Fatal, Info, Warn};
    match [Debug, Info, Warn, Error, Fatal].into_iter().find(|severity| *severity as u8 == level) {
        None if level != 0 => {
            Err(format!("log level {level} is none: there are 10, 20, 30, 40, 50, and 0 for the process's"))
        }
        known => Ok(known),
    }
}

/// Reads the extra arguments, which are those of rclcpp's containers. Messages between components go through shared memory without a
/// copy, with or without `use_intra_process_comms`.
fn forward_global_arguments(messages: &[msg::Parameter]) -> Result<bool, String> {
    let mut forward = false;
    for (name, value) in parameters("extra argument", messages)? {
        match (name.as_str(), value) {
            ("use_intra_process_comms", ParameterValue::Bool(_)) => {}
            ("forward_global_arguments", ParameterValue::Bool(value)) => forward = value,
            ("use_intra_process_comms" | "forward_global_arguments", other) => {
                return Err(format!("extra argument '{name}' is true or false, not {other}"));
            }
            _ => {
                return Err(format!(
                    "extra argument '{name}' is not known: there are use_intra_process_comms and forward_global_arguments"
                ));
            }
        }
    }
    Ok(forward)
}

fn unload(container: &mut Container, request: &UnloadNode::Request) -> UnloadNode::Response {
    match container.unload(request.unique_id) {
        Ok(()) => UnloadNode::Response { success: true, ..Default::default() },
        Err(error) => UnloadNode::Response { error_message: error.to_string(), ..Default::default() },
    }
}

fn list(container: &Container) -> ListNodes::Response {
    let (unique_ids, full_node_names) = container.list().map(|(id, name)| (id, name.to_owned())).unzip();
    ListNodes::Response { full_node_names, unique_ids }
}
