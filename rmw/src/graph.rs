// SPDX-License-Identifier: MIT OR Apache-2.0
//! The graph of the domain, in ROS's structs.

use crate::bindings::*;
use crate::distro;
use crate::error::{Error, Result, checked};
use crate::handle::exported;
use crate::qos;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{CString, c_char};
use tautline_transport::{EndpointKind, GraphSnapshot, NodeName, ServiceKind, TopicEndpoint};

/// Names, each with its types.
type Names<'g> = BTreeMap<&'g str, BTreeSet<&'g str>>;

fn c_string(text: &str) -> CString {
    CString::new(text).unwrap_or_default()
}

/// Fills a zero array of strings.
fn fill<'t>(
    array: &mut rcutils_string_array_t,
    texts: impl ExactSizeIterator<Item = &'t str>,
    allocator: &rcutils_allocator_t,
) -> Result {
    // SAFETY: zero, as checked or just created; indices are within the requested size.
    unsafe {
        if rcutils_string_array_init(array, texts.len(), allocator) != RET_OK {
            return Err(Error::new(RET_BAD_ALLOC, "no memory for names"));
        }
        for (index, text) in texts.enumerate() {
            let copy = rcutils_strdup(c_string(text).as_ptr(), *allocator);
            *array.data.add(index) = copy;
            if copy.is_null() {
                let _ = rcutils_string_array_fini(array);
                return Err(Error::new(RET_BAD_ALLOC, "no memory for a name"));
            }
        }
    }
    Ok(())
}

/// Checks an allocator, which here needs no `reallocate`.
fn check_allocator(allocator: &rcutils_allocator_t) -> Result {
    let rcutils_allocator_t { allocate, deallocate, zero_allocate, .. } = allocator;
    match (allocate, deallocate, zero_allocate) {
        (Some(_), Some(_), Some(_)) => Ok(()),
        _ => Err(Error::invalid("the allocator is not initialised")),
    }
}

/// Checks the arguments of [`fill_names`], before the graph is read.
fn check_names(place: &mut rmw_names_and_types_t, allocator: &rcutils_allocator_t) -> Result {
    check_allocator(allocator)?;
    // SAFETY: a valid list.
    match unsafe { rmw_names_and_types_check_zero(place) } {
        RET_OK => Ok(()),
        _ => Err(Error::invalid("the list of names is not zero")),
    }
}

/// Fills a list of names, checked to be zero, with their types.
fn fill_names(
    place: &mut rmw_names_and_types_t,
    names: &Names,
    allocator: &mut rcutils_allocator_t,
) -> Result {
    if names.is_empty() {
        return Ok(());
    }
    // SAFETY: a valid list; indices are within the requested size.
    unsafe {
        checked(rmw_names_and_types_init(place, names.len(), allocator), "making a list of names")?;
        for (index, (name, types)) in names.iter().enumerate() {
            let copy = rcutils_strdup(c_string(name).as_ptr(), *allocator);
            *place.names.data.add(index) = copy;
            let filled = match copy.is_null() {
                true => Err(Error::new(RET_BAD_ALLOC, "no memory for a name")),
                false => fill(&mut *place.types.add(index), types.iter().copied(), allocator),
            };
            if filled.is_err() {
                let _ = rmw_names_and_types_fini(place);
                return filled;
            }
        }
    }
    Ok(())
}

fn check_empty(array: &rcutils_string_array_t, what: &str) -> Result {
    match array.size == 0 && array.data.is_null() {
        true => Ok(()),
        false => Err(Error::invalid(format!("{what} is not zero"))),
    }
}

fn node_names(
    graph: &GraphSnapshot,
    names: &mut rcutils_string_array_t,
    namespaces: &mut rcutils_string_array_t,
    enclaves: Option<&mut rcutils_string_array_t>,
) -> Result {
    check_empty(names, "the names")?;
    check_empty(namespaces, "the namespaces")?;
    enclaves.iter().try_for_each(|enclaves| check_empty(enclaves, "the enclaves"))?;
    // SAFETY: no conditions.
    let allocator = unsafe { rcutils_get_default_allocator() };
    let nodes = &graph.nodes;
    fill(names, nodes.iter().map(|node| node.name.name.as_str()), &allocator)?;
    let mut filled = fill(namespaces, nodes.iter().map(|node| node.name.namespace.as_str()), &allocator);
    if let (Ok(()), Some(enclaves)) = (&filled, enclaves) {
        filled = fill(enclaves, nodes.iter().map(|node| node.enclave.as_str()), &allocator);
        if filled.is_err() {
            // SAFETY: filled above.
            let _ = unsafe { rcutils_string_array_fini(namespaces) };
        }
    }
    if filled.is_err() {
        // SAFETY: filled above.
        let _ = unsafe { rcutils_string_array_fini(names) };
    }
    filled
}

/// Topics with their types: of endpoints of one kind, of one node, or all.
fn topics<'g>(graph: &'g GraphSnapshot, kind: Option<EndpointKind>, node: Option<&NodeName>) -> Names<'g> {
    let mut names = Names::new();
    for end in &graph.endpoints {
        if kind.is_none_or(|kind| kind == end.kind) && (node.is_none() || end.node.as_ref() == node) {
            names.entry(&end.topic).or_default().insert(&end.topic_type.name);
        }
    }
    names
}

/// Services, as [`topics`].
fn services<'g>(graph: &'g GraphSnapshot, kind: Option<ServiceKind>, node: Option<&NodeName>) -> Names<'g> {
    let mut names = Names::new();
    for end in &graph.services {
        if kind.is_none_or(|kind| kind == end.kind) && (node.is_none() || end.node.as_ref() == node) {
            names.entry(&end.name).or_default().insert(&end.type_name);
        }
    }
    names
}

/// Returns the name of a node, or an error if it does not exist.
fn node_of(graph: &GraphSnapshot, name: &str, namespace: &str) -> Result<NodeName> {
    let wanted = NodeName { namespace: namespace.to_owned(), name: name.to_owned() };
    match graph.nodes.iter().any(|node| node.name == wanted) {
        true => Ok(wanted),
        false => Err(Error::new(RET_NODE_NAME_NON_EXISTENT, format!("node {wanted} does not exist"))),
    }
}

fn ends_of(graph: &GraphSnapshot, topic: &str, kind: EndpointKind) -> usize {
    graph.endpoints.iter().filter(|end| end.kind == kind && end.topic == topic).count()
}

fn services_of(graph: &GraphSnapshot, name: &str, kind: ServiceKind) -> usize {
    graph.services.iter().filter(|end| end.kind == kind && end.name == name).count()
}

/// The endpoints of one kind on a topic.
fn fill_infos(
    infos: &mut rmw_topic_endpoint_info_array_t,
    graph: &GraphSnapshot,
    topic: &str,
    kind: EndpointKind,
    allocator: &mut rcutils_allocator_t,
) -> Result {
    check_allocator(allocator)?;
    let ends: Vec<_> = graph.endpoints.iter().filter(|end| end.kind == kind && end.topic == topic).collect();
    // SAFETY: a valid array; indices are within the requested size.
    unsafe {
        if rmw_topic_endpoint_info_array_check_zero(infos) != RET_OK {
            return Err(Error::invalid("the information is not zero"));
        }
        let made = rmw_topic_endpoint_info_array_init_with_size(infos, ends.len(), allocator);
        checked(made, "allocating endpoint information")?;
        for (index, end) in ends.into_iter().enumerate() {
            if let Err(error) = write_info(&mut *infos.info_array.add(index), end, allocator) {
                let _ = rmw_topic_endpoint_info_array_fini(infos, allocator);
                return Err(error);
            }
        }
    }
    Ok(())
}

fn write_info(
    info: &mut rmw_topic_endpoint_info_t,
    end: &TopicEndpoint,
    allocator: &mut rcutils_allocator_t,
) -> Result {
    // SAFETY: no conditions.
    *info = unsafe { rmw_get_zero_initialized_topic_endpoint_info() };
    // rmw_fastrtps's names for an endpoint without a node.
    let (name, namespace) = end
        .node
        .as_ref()
        .map_or(("_NODE_NAME_UNKNOWN_", "_NODE_NAMESPACE_UNKNOWN_"), |node| (&node.name, &node.namespace));
    let (name, namespace) = (c_string(name), c_string(namespace));
    let topic_type = c_string(&end.topic_type.name);
    let (endpoint, profile) = match end.kind {
        EndpointKind::Publisher => (RMW_ENDPOINT_PUBLISHER, qos::to_ros(&end.qos, false)),
        EndpointKind::Subscription => (RMW_ENDPOINT_SUBSCRIPTION, qos::to_ros(&end.qos, false)),
    };
    // SAFETY: texts that outlive the calls, which copy them.
    unsafe {
        for code in [
            rmw_topic_endpoint_info_set_node_name(info, name.as_ptr(), allocator),
            rmw_topic_endpoint_info_set_node_namespace(info, namespace.as_ptr(), allocator),
            rmw_topic_endpoint_info_set_topic_type(info, topic_type.as_ptr(), allocator),
            distro::set_type_hash(info, end.topic_type.hash.as_deref()),
            rmw_topic_endpoint_info_set_endpoint_type(info, endpoint),
            rmw_topic_endpoint_info_set_gid(info, end.gid.0.as_ptr(), end.gid.0.len()),
            rmw_topic_endpoint_info_set_qos_profile(info, &profile),
        ] {
            checked(code, "writing endpoint information")?;
        }
    }
    Ok(())
}

exported! {
    fn rmw_get_node_names(
        node: *const rmw_node_t => behind,
        names: *mut rcutils_string_array_t => place "the names",
        namespaces: *mut rcutils_string_array_t => place "the namespaces",
    ) {
        node_names(&*node.participant.graph()?, names, namespaces, None)
    }

    fn rmw_get_node_names_with_enclaves(
        node: *const rmw_node_t => behind,
        names: *mut rcutils_string_array_t => place "the names",
        namespaces: *mut rcutils_string_array_t => place "the namespaces",
        enclaves: *mut rcutils_string_array_t => place "the enclaves",
    ) {
        node_names(&*node.participant.graph()?, names, namespaces, Some(enclaves))
    }

    fn rmw_get_topic_names_and_types(
        node: *const rmw_node_t => behind,
        allocator: *mut rcutils_allocator_t => place "the allocator",
        _no_demangle: bool,
        names: *mut rmw_names_and_types_t => place "the list of names",
    ) {
        check_names(names, allocator)?;
        fill_names(names, &topics(&*node.participant.graph()?, None, None), allocator)
    }

    fn rmw_get_service_names_and_types(
        node: *const rmw_node_t => behind,
        allocator: *mut rcutils_allocator_t => place "the allocator",
        names: *mut rmw_names_and_types_t => place "the list of names",
    ) {
        check_names(names, allocator)?;
        fill_names(names, &services(&*node.participant.graph()?, None, None), allocator)
    }
}

/// Defines functions that list names of one kind of a node.
macro_rules! by_node {
    ($($function:ident($($unused:ident)?): $of:ident, $kind:expr;)*) => { exported! {$(
        fn $function(
            node: *const rmw_node_t => behind,
            allocator: *mut rcutils_allocator_t => place "the allocator",
            name: *const c_char => node_name,
            namespace: *const c_char => namespace,
            $($unused: bool,)?
            names: *mut rmw_names_and_types_t => place "the list of names",
        ) {
            check_names(names, allocator)?;
            let graph = node.participant.graph()?;
            let node = node_of(&graph, name, namespace)?;
            fill_names(names, &$of(&graph, Some($kind), Some(&node)), allocator)
        }
    )*}};
}

by_node! {
    rmw_get_publisher_names_and_types_by_node(_no_demangle): topics, EndpointKind::Publisher;
    rmw_get_subscriber_names_and_types_by_node(_no_demangle): topics, EndpointKind::Subscription;
    rmw_get_service_names_and_types_by_node(): services, ServiceKind::Server;
    rmw_get_client_names_and_types_by_node(): services, ServiceKind::Client;
}

/// Defines functions that return information on the endpoints of one kind on a topic.
macro_rules! by_topic {
    ($($function:ident: $kind:expr;)*) => { exported! {$(
        fn $function(
            node: *const rmw_node_t => behind,
            allocator: *mut rcutils_allocator_t => place "the allocator",
            topic: *const c_char => text "the topic's name",
            _no_mangle: bool,
            infos: *mut rmw_topic_endpoint_info_array_t => place "the information",
        ) {
            fill_infos(infos, &*node.participant.graph()?, topic, $kind, allocator)
        }
    )*}};
}

by_topic! {
    rmw_get_publishers_info_by_topic: EndpointKind::Publisher;
    rmw_get_subscriptions_info_by_topic: EndpointKind::Subscription;
}

/// Defines functions that count the endpoints of a topic or service.
macro_rules! counts {
    ($($function:ident: $of:ident, $kind:expr;)*) => { exported! {$(
        fn $function(
            node: *const rmw_node_t => behind,
            name: *const c_char => full_name "the name",
            count: *mut usize => place "the count",
        ) {
            *count = $of(&*node.participant.graph()?, name, $kind);
            Ok(())
        }
    )*}};
}

counts! {
    rmw_count_publishers: ends_of, EndpointKind::Publisher;
    rmw_count_subscribers: ends_of, EndpointKind::Subscription;
    rmw_count_clients: services_of, ServiceKind::Client;
    rmw_count_services: services_of, ServiceKind::Server;
}
