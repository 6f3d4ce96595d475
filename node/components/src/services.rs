// SPDX-License-Identifier: MIT OR Apache-2.0
//! The services of a container, as in ROS 2: loading, unloading and listing components.

use crate::container::{Container, Load};
use futures::StreamExt;
use std::future::{Future, ready};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tautline::composition_interfaces::srv::{ListNodes, LoadNode, UnloadNode};
use tautline::{Node, QosProfile, RemapRules};

/// A container for several threads.
pub type SharedContainer = Arc<Mutex<Container>>;

/// Offers `~/_container/load_node`, `unload_node` and `list_nodes` of `node`. They answer as long as the future is polled, which
/// never ends; components are made, and their ends waited for, in its thread.
///
/// A request's `package_name` is the path of a library, its `plugin_name` the component. What a request asks besides a node's name,
/// namespace and remapping rules is refused.
///
/// # Errors
/// [`tautline::Error::Transport`] if a service cannot be had.
pub fn serve(
    container: &SharedContainer,
    node: &mut Node,
) -> tautline::Result<impl Future<Output = ()> + Send + use<>> {
    let qos = QosProfile::services_default();
    let loads = node.create_service::<LoadNode::Service>("~/_container/load_node", qos)?;
    let unloads = node.create_service::<UnloadNode::Service>("~/_container/unload_node", qos)?;
    let lists = node.create_service::<ListNodes::Service>("~/_container/list_nodes", qos)?;
    let container = container.clone();
    Ok(async move {
        // Who asked is told; if it has gone, nobody is.
        let loads = loads.for_each(|request| {
            let response = load(&mut lock(&container), &request.message);
            ready(drop(request.respond(response)))
        });
        let unloads = unloads.for_each(|request| {
            let response = unload(&mut lock(&container), &request.message);
            ready(drop(request.respond(response)))
        });
        let lists = lists.for_each(|request| {
            let response = list(&lock(&container));
            ready(drop(request.respond(response)))
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

/// What a request wants, if it wants nothing that is not done.
fn described(request: &LoadNode::Request) -> Result<Load, String> {
    for (field, is_used) in [
        ("parameters", !request.parameters.is_empty()),
        ("extra_arguments", !request.extra_arguments.is_empty()),
        ("log_level", request.log_level != 0),
    ] {
        if is_used {
            return Err(format!("'{field}' of a load request is not supported: leave it empty"));
        }
    }
    let remap = RemapRules::parse(&request.remap_rules).map_err(|error| error.to_string())?;
    Ok(Load {
        library: request.package_name.clone().into(),
        component: request.plugin_name.clone(),
        name: request.node_name.clone(),
        namespace: request.node_namespace.clone(),
        remap,
    })
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
