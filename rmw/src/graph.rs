// SPDX-License-Identifier: MIT OR Apache-2.0
//! The graph of the domain, in ROS's structs.

use crate::bindings::*;
use crate::distro;
use crate::error::{Error, Result, answer, checked};
use crate::handle::{behind, place, text};
use crate::node::{check_full_name, check_namespace, check_node_name};
use crate::qos;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{CString, c_char};
use std::sync::Arc;
use tautline_transport::{EndpointKind, GraphSnapshot, NodeName, ServiceKind, TopicEndpoint};

/// Names, each with its types.
type Names<'g> = BTreeMap<&'g str, BTreeSet<&'g str>>;

fn c_string(text: &str) -> CString {
    CString::new(text).unwrap_or_default()
}

/// The current graph of a node's participant.
///
/// # Safety
/// As documented by rmw.
unsafe fn graph(node: *const rmw_node_t) -> Result<Arc<GraphSnapshot>> {
    // SAFETY: the caller's contract.
    Ok(unsafe { behind(node)? }.participant.graph()?)
}

/// # Safety
/// As documented by rmw.
unsafe fn allocator<'a>(allocator: *mut rcutils_allocator_t) -> Result<&'a mut rcutils_allocator_t> {
    // SAFETY: the caller's contract.
    let allocator = unsafe { place(allocator, "the allocator")? };
    if allocator.allocate.is_none() || allocator.deallocate.is_none() || allocator.zero_allocate.is_none() {
        return Err(Error::invalid("the allocator is not initialised"));
    }
    Ok(allocator)
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

/// Fills a zero list of names with their types.
fn fill_names(
    place: &mut rmw_names_and_types_t,
    names: &Names,
    allocator: &mut rcutils_allocator_t,
) -> Result {
    if names.is_empty() {
        return Ok(());
    }
    // SAFETY: zero, as checked; indices are within the requested size.
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

/// # Safety
/// As documented by rmw.
unsafe fn zero_names<'n>(names: *mut rmw_names_and_types_t) -> Result<&'n mut rmw_names_and_types_t> {
    // SAFETY: the caller's contract.
    unsafe {
        let names = place(names, "the list of names")?;
        if rmw_names_and_types_check_zero(names) != RET_OK {
            return Err(Error::invalid("the list of names is not zero"));
        }
        Ok(names)
    }
}

/// # Safety
/// As documented by rmw.
unsafe fn zero_array<'a>(
    array: *mut rcutils_string_array_t,
    what: &str,
) -> Result<&'a mut rcutils_string_array_t> {
    // SAFETY: the caller's contract.
    let array = unsafe { place(array, what)? };
    match array.size == 0 && array.data.is_null() {
        true => Ok(array),
        false => Err(Error::invalid(format!("{what} is not zero"))),
    }
}

/// # Safety
/// As documented by rmw.
unsafe fn node_names(
    node: *const rmw_node_t,
    names: *mut rcutils_string_array_t,
    namespaces: *mut rcutils_string_array_t,
    enclaves: Option<*mut rcutils_string_array_t>,
) -> Result {
    // SAFETY: the caller's contract.
    let (graph, names, namespaces, enclaves) = unsafe {
        let graph = graph(node)?;
        let (names, namespaces) =
            (zero_array(names, "the names")?, zero_array(namespaces, "the namespaces")?);
        (graph, names, namespaces, enclaves.map(|enclaves| zero_array(enclaves, "the enclaves")).transpose()?)
    };
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

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_node_names(
    node: *const rmw_node_t,
    names: *mut rcutils_string_array_t,
    namespaces: *mut rcutils_string_array_t,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    answer(|| unsafe { node_names(node, names, namespaces, None) })
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_node_names_with_enclaves(
    node: *const rmw_node_t,
    names: *mut rcutils_string_array_t,
    namespaces: *mut rcutils_string_array_t,
    enclaves: *mut rcutils_string_array_t,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    answer(|| unsafe { node_names(node, names, namespaces, Some(enclaves)) })
}

fn topics(graph: &GraphSnapshot, is_wanted: impl Fn(&TopicEndpoint) -> bool) -> Names<'_> {
    let mut names = Names::new();
    for end in graph.endpoints.iter().filter(|end| is_wanted(end)) {
        names.entry(&end.topic).or_default().insert(&end.topic_type.name);
    }
    names
}

fn services<'g>(graph: &'g GraphSnapshot, kind: Option<ServiceKind>, node: Option<&NodeName>) -> Names<'g> {
    let mut names = Names::new();
    for end in &graph.services {
        let is_wanted =
            kind.is_none_or(|kind| kind == end.kind) && (node.is_none() || end.node.as_ref() == node);
        if is_wanted {
            names.entry(&end.name).or_default().insert(&end.type_name);
        }
    }
    names
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_topic_names_and_types(
    node: *const rmw_node_t,
    allocator_given: *mut rcutils_allocator_t,
    _no_demangle: bool,
    names: *mut rmw_names_and_types_t,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's contract.
        let (graph, allocator, names) =
            unsafe { (graph(node)?, allocator(allocator_given)?, zero_names(names)?) };
        fill_names(names, &topics(&graph, |_| true), allocator)
    })
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_service_names_and_types(
    node: *const rmw_node_t,
    allocator_given: *mut rcutils_allocator_t,
    names: *mut rmw_names_and_types_t,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's contract.
        let (graph, allocator, names) =
            unsafe { (graph(node)?, allocator(allocator_given)?, zero_names(names)?) };
        fill_names(names, &services(&graph, None, None), allocator)
    })
}

/// The names that `of` finds for one node.
///
/// # Safety
/// As documented by rmw.
unsafe fn by_node(
    node: *const rmw_node_t,
    allocator_given: *mut rcutils_allocator_t,
    name: *const c_char,
    namespace: *const c_char,
    names: *mut rmw_names_and_types_t,
    of: for<'g> fn(&'g GraphSnapshot, &NodeName) -> Names<'g>,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: the caller's contract.
        let (graph, allocator, names, wanted) = unsafe {
            let (graph, allocator) = (graph(node)?, allocator(allocator_given)?);
            check_node_name(name)?;
            check_namespace(namespace)?;
            let names = zero_names(names)?;
            let (name, namespace) = (text(name, "the node's name")?, text(namespace, "the namespace")?);
            (graph, allocator, names, NodeName { namespace: namespace.to_owned(), name: name.to_owned() })
        };
        if !graph.nodes.iter().any(|node| node.name == wanted) {
            return Err(Error::new(RET_NODE_NAME_NON_EXISTENT, format!("node {wanted} does not exist")));
        }
        fill_names(names, &of(&graph, &wanted), allocator)
    })
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_publisher_names_and_types_by_node(
    node: *const rmw_node_t,
    allocator: *mut rcutils_allocator_t,
    name: *const c_char,
    namespace: *const c_char,
    _no_demangle: bool,
    names: *mut rmw_names_and_types_t,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe {
        by_node(node, allocator, name, namespace, names, |graph, node| {
            topics(graph, |end| end.kind == EndpointKind::Publisher && end.node.as_ref() == Some(node))
        })
    }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_subscriber_names_and_types_by_node(
    node: *const rmw_node_t,
    allocator: *mut rcutils_allocator_t,
    name: *const c_char,
    namespace: *const c_char,
    _no_demangle: bool,
    names: *mut rmw_names_and_types_t,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe {
        by_node(node, allocator, name, namespace, names, |graph, node| {
            topics(graph, |end| end.kind == EndpointKind::Subscription && end.node.as_ref() == Some(node))
        })
    }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_service_names_and_types_by_node(
    node: *const rmw_node_t,
    allocator: *mut rcutils_allocator_t,
    name: *const c_char,
    namespace: *const c_char,
    names: *mut rmw_names_and_types_t,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe {
        by_node(node, allocator, name, namespace, names, |graph, node| {
            services(graph, Some(ServiceKind::Server), Some(node))
        })
    }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_client_names_and_types_by_node(
    node: *const rmw_node_t,
    allocator: *mut rcutils_allocator_t,
    name: *const c_char,
    namespace: *const c_char,
    names: *mut rmw_names_and_types_t,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe {
        by_node(node, allocator, name, namespace, names, |graph, node| {
            services(graph, Some(ServiceKind::Client), Some(node))
        })
    }
}

/// The endpoints of one kind on a topic.
///
/// # Safety
/// As documented by rmw.
unsafe fn info_by_topic(
    node: *const rmw_node_t,
    allocator_given: *mut rcutils_allocator_t,
    topic: *const c_char,
    infos: *mut rmw_topic_endpoint_info_array_t,
    kind: EndpointKind,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: the caller's contract.
        let (graph, allocator, topic, infos) = unsafe {
            let (graph, allocator) = (graph(node)?, allocator(allocator_given)?);
            let (topic, infos) = (text(topic, "the topic's name")?, place(infos, "the information")?);
            if rmw_topic_endpoint_info_array_check_zero(infos) != RET_OK {
                return Err(Error::invalid("the information is not zero"));
            }
            (graph, allocator, topic, infos)
        };
        let ends: Vec<_> =
            graph.endpoints.iter().filter(|end| end.kind == kind && end.topic == topic).collect();
        // SAFETY: zero, as checked; indices are within the requested size.
        unsafe {
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
    })
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

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_publishers_info_by_topic(
    node: *const rmw_node_t,
    allocator: *mut rcutils_allocator_t,
    topic: *const c_char,
    _no_mangle: bool,
    infos: *mut rmw_topic_endpoint_info_array_t,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe { info_by_topic(node, allocator, topic, infos, EndpointKind::Publisher) }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_get_subscriptions_info_by_topic(
    node: *const rmw_node_t,
    allocator: *mut rcutils_allocator_t,
    topic: *const c_char,
    _no_mangle: bool,
    infos: *mut rmw_topic_endpoint_info_array_t,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe { info_by_topic(node, allocator, topic, infos, EndpointKind::Subscription) }
}

/// The number that `of` counts for a name.
///
/// # Safety
/// As documented by rmw.
unsafe fn count(
    node: *const rmw_node_t,
    name: *const c_char,
    counted: *mut usize,
    of: fn(&GraphSnapshot, &str) -> usize,
) -> rmw_ret_t {
    answer(|| {
        // SAFETY: the caller's contract.
        let (graph, name, counted) = unsafe {
            let graph = graph(node)?;
            check_full_name(name, "the name")?;
            (graph, text(name, "the name")?, place(counted, "the count")?)
        };
        *counted = of(&graph, name);
        Ok(())
    })
}

fn ends_of(graph: &GraphSnapshot, topic: &str, kind: EndpointKind) -> usize {
    graph.endpoints.iter().filter(|end| end.kind == kind && end.topic == topic).count()
}

fn services_of(graph: &GraphSnapshot, name: &str, kind: ServiceKind) -> usize {
    graph.services.iter().filter(|end| end.kind == kind && end.name == name).count()
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_count_publishers(
    node: *const rmw_node_t,
    topic: *const c_char,
    counted: *mut usize,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe { count(node, topic, counted, |graph, name| ends_of(graph, name, EndpointKind::Publisher)) }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_count_subscribers(
    node: *const rmw_node_t,
    topic: *const c_char,
    counted: *mut usize,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe { count(node, topic, counted, |graph, name| ends_of(graph, name, EndpointKind::Subscription)) }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_count_clients(
    node: *const rmw_node_t,
    service: *const c_char,
    counted: *mut usize,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe { count(node, service, counted, |graph, name| services_of(graph, name, ServiceKind::Client)) }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_count_services(
    node: *const rmw_node_t,
    service: *const c_char,
    counted: *mut usize,
) -> rmw_ret_t {
    // SAFETY: rmw's contract.
    unsafe { count(node, service, counted, |graph, name| services_of(graph, name, ServiceKind::Server)) }
}
