// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes.

use crate::bindings::*;
use crate::context::Context;
use crate::error::{Error, Result, answer, checked, made};
use crate::guard;
use crate::handle::{
    EndpointHandle, IDENTIFIER, behind, behind_context, copy_text, free_text, take_back, text,
};
use crate::signal::Signal;
use std::ffi::{CStr, c_char, c_int, c_void};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tautline_transport::{NodeHandle, Participant};

pub(crate) struct Node {
    context: *const Context,
    /// Including its namespace.
    pub(crate) full_name: String,
    /// Creates the node's entities.
    pub(crate) participant: Participant,
    /// As the owner of endpoints in traces.
    pub(crate) traced: tautline_trace::Object,
    _handle: NodeHandle,
    graph_guard: *mut rmw_guard_condition_t,
    /// Endpoints that ROS has not destroyed.
    endpoints: Mutex<Vec<OwnedEndpoint>>,
}

/// A handle of ROS's, and what ends the endpoint behind it.
struct OwnedEndpoint {
    handle: *mut c_void,
    end: unsafe fn(*mut c_void),
}

/// Ends the endpoint behind a handle of type `H`, which stays.
///
/// # Safety
/// The handle is valid and ours, and its endpoint is no longer used.
unsafe fn end<H: EndpointHandle>(handle: *mut c_void) {
    // SAFETY: the caller's contract.
    drop(unsafe { take_back::<H::Data>((*handle.cast::<H>()).take_data()) });
}

impl Node {
    /// Its context, which outlives its nodes.
    pub(crate) fn context(&self) -> &Context {
        // SAFETY: `rmw_context_fini` refuses to end a context that has nodes.
        unsafe { &*self.context }
    }

    fn endpoints(&self) -> MutexGuard<'_, Vec<OwnedEndpoint>> {
        self.endpoints.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The endpoint ends with this node at the latest.
    pub(crate) fn own<H: EndpointHandle>(&self, handle: *mut H) {
        self.endpoints().push(OwnedEndpoint { handle: handle.cast(), end: end::<H> });
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        for endpoint in std::mem::take(&mut *self.endpoints()) {
            // SAFETY: rmw's contract: no endpoint is used after its node, and what was destroyed is not in the list. Client libraries
            // forget some, whose handles they never free.
            unsafe { (endpoint.end)(endpoint.handle) };
        }
    }
}

/// Destroys an endpoint of a node.
///
/// # Safety
/// As documented by rmw for each function that destroys an endpoint.
pub(crate) unsafe fn destroy_endpoint<H: EndpointHandle>(node: *mut rmw_node_t, handle: *mut H) -> Result {
    // SAFETY: the caller's contract; what the node owns is ours, and in its list once.
    unsafe {
        let node = behind(node)?;
        behind(handle)?;
        let owned = {
            let mut endpoints = node.endpoints();
            let at = endpoints.iter().position(|owned| owned.handle == handle.cast());
            let at = at.ok_or_else(|| Error::invalid(format!("{} belongs to another node", H::WHAT)))?;
            endpoints.swap_remove(at)
        };
        if node.context().is_of_this_process() {
            (owned.end)(owned.handle);
        }
        H::free(handle);
    }
    Ok(())
}

type Validate = unsafe extern "C" fn(*const c_char, *mut c_int, *mut usize) -> rmw_ret_t;
type Explain = unsafe extern "C" fn(c_int) -> *const c_char;

/// Checks a name against the rules of its kind.
///
/// # Safety
/// `name` is null or NUL-terminated.
unsafe fn check_name(name: *const c_char, what: &str, validate: Validate, explain: Explain) -> Result {
    if name.is_null() {
        return Err(Error::null(what));
    }
    let (mut found, mut at) = (0, 0);
    // SAFETY: the caller's contract; the pointers are valid; the explanation is a constant, or null.
    let explained = unsafe {
        checked(validate(name, &mut found, &mut at), "checking a name")?;
        let explained = explain(found);
        (!explained.is_null()).then(|| CStr::from_ptr(explained).to_string_lossy())
    };
    match explained {
        // Zero means valid.
        Some(reason) if found != 0 => Err(Error::invalid(format!("{what}: {reason} (at byte {at})"))),
        _ => Ok(()),
    }
}

/// # Safety
/// As [`check_name`].
pub(crate) unsafe fn check_node_name(name: *const c_char) -> Result {
    // SAFETY: the caller's contract.
    unsafe {
        check_name(name, "the node's name", rmw_validate_node_name, rmw_node_name_validation_result_string)
    }
}

/// # Safety
/// As [`check_name`].
pub(crate) unsafe fn check_namespace(name: *const c_char) -> Result {
    // SAFETY: the caller's contract.
    unsafe {
        check_name(name, "the namespace", rmw_validate_namespace, rmw_namespace_validation_result_string)
    }
}

/// Checks the name of a topic or service.
///
/// # Safety
/// As [`check_name`].
pub(crate) unsafe fn check_full_name(name: *const c_char, what: &str) -> Result {
    // SAFETY: the caller's contract.
    unsafe {
        check_name(name, what, rmw_validate_full_topic_name, rmw_full_topic_name_validation_result_string)
    }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_create_node(
    context: *mut rmw_context_t,
    name: *const c_char,
    namespace: *const c_char,
) -> *mut rmw_node_t {
    made(|| {
        // SAFETY: rmw's contract.
        let (behind, name, namespace) = unsafe {
            let behind = behind_context(context)?;
            behind.check()?;
            check_node_name(name)?;
            check_namespace(namespace)?;
            (behind, text(name, "the node's name")?, text(namespace, "the namespace")?)
        };
        let handle = behind.participant.create_node_in_enclave(name, namespace, &behind.enclave)?;
        let participant = behind.participant.for_node(&handle);
        let signal = Arc::<Signal>::default();
        behind.watch_graph(&signal);
        let graph_guard = guard::create(context, signal)?;
        let full_name = format!("{}/{name}", namespace.trim_end_matches('/'));
        behind.system.warn_of_unseen(&full_name);
        let endpoints = Mutex::default();
        let traced = tautline_trace::node_init(behind.participant.trace_id(), name, namespace);
        let node =
            Node { context: behind, full_name, participant, traced, _handle: handle, graph_guard, endpoints };
        // SAFETY: rmw's own memory, written before anyone can see it.
        unsafe {
            let handle = rmw_node_allocate();
            if handle.is_null() {
                guard::destroy(graph_guard);
                return Err(Error::new(RET_BAD_ALLOC, "no memory for a node"));
            }
            let (copied_name, copied_namespace) = (copy_text(name)?, copy_text(namespace)?);
            behind.nodes.fetch_add(1, Ordering::AcqRel);
            handle.write(rmw_node_t {
                implementation_identifier: IDENTIFIER.as_ptr(),
                data: Box::into_raw(Box::new(node)).cast(),
                name: copied_name,
                namespace_: copied_namespace,
                context,
            });
            Ok(handle)
        }
    })
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_destroy_node(handle: *mut rmw_node_t) -> rmw_ret_t {
    answer(|| {
        // SAFETY: rmw's contract; checked to be ours, so created above.
        unsafe {
            behind(handle)?;
            let node = take_back::<Node>((*handle).data);
            let (context, graph_guard) = (node.context, node.graph_guard);
            if node.context().is_of_this_process() {
                drop(node)
            } else {
                std::mem::forget(node)
            }
            guard::destroy(graph_guard);
            (*context).nodes.fetch_sub(1, Ordering::AcqRel);
            free_text((*handle).name);
            free_text((*handle).namespace_);
            rmw_node_free(handle);
        }
        Ok(())
    })
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_node_get_graph_guard_condition(
    handle: *const rmw_node_t,
) -> *const rmw_guard_condition_t {
    // SAFETY: rmw's contract.
    made(|| Ok(unsafe { behind(handle)? }.graph_guard))
}
