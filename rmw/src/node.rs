// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes.

use crate::bindings::*;
use crate::context::Context;
use crate::error::{Error, Result};
use crate::guard;
use crate::handle::{EndpointHandle, IDENTIFIER, behind, copy_text, exported, free_text, handle, take_back};
use crate::signal::Signal;
use std::ffi::{c_char, c_void};
use std::ops::Deref;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tautline_transport::{NodeHandle, Participant};

pub(crate) struct Node {
    context: *const Context,
    /// Including its namespace.
    pub(crate) full_name: String,
    /// Creates the node's entities.
    pub(crate) participant: Participant,
    /// The node as the owner of endpoints in traces.
    pub(crate) traced: tautline_trace::Object,
    _handle: NodeHandle,
    graph_guard: *mut rmw_guard_condition_t,
    /// Endpoints that ROS has not destroyed.
    endpoints: Mutex<Vec<OwnedEndpoint>>,
}

handle!(rmw_node_t, Node, "the node");

/// A handle of ROS's, and the function that drops the endpoint behind it.
struct OwnedEndpoint {
    handle: *mut c_void,
    end: unsafe fn(*mut c_void),
}

/// Drops the endpoint behind a handle of type `H`; the handle stays.
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

    /// An error in a forked child. Checked before any lock of the node's endpoints is taken, which a thread of the parent may have held
    /// at the fork.
    pub(crate) fn check_process(&self) -> Result {
        self.context().waiters.check_process()
    }

    fn endpoints(&self) -> MutexGuard<'_, Vec<OwnedEndpoint>> {
        self.endpoints.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Creates the handle of an endpoint with this name and data, which the node owns; `fill` sets further fields.
    pub(crate) fn hand_out<H: EndpointHandle>(
        &self,
        name: &str,
        data: H::Data,
        fill: impl FnOnce(&mut H),
    ) -> Result<*mut H> {
        let (name, handle) = (copy_text(name)?, H::allocate());
        if handle.is_null() {
            // SAFETY: copied above.
            unsafe { free_text(name) };
            return Err(Error::new(RET_BAD_ALLOC, format!("no memory for {}", H::WHAT)));
        }
        let mut made = H::default();
        made.set(Box::into_raw(Box::new(data)).cast(), name);
        fill(&mut made);
        // SAFETY: librmw's memory for it, which nobody else has yet.
        unsafe { handle.write(made) };
        // Dropped with this node at the latest.
        self.endpoints().push(OwnedEndpoint { handle: handle.cast(), end: end::<H> });
        Ok(handle)
    }

    /// Destroys one of the node's endpoints.
    ///
    /// # Safety
    /// As documented by rmw for each function that does.
    pub(crate) unsafe fn destroy<H: EndpointHandle>(&self, handle: *mut H) -> Result {
        // SAFETY: the caller's contract; what the node owns is ours, and in its list once.
        unsafe {
            behind(handle)?;
            if self.context().is_of_this_process() {
                let owned = {
                    let mut endpoints = self.endpoints();
                    let at = endpoints.iter().position(|owned| owned.handle == handle.cast());
                    let at =
                        at.ok_or_else(|| Error::invalid(format!("{} belongs to another node", H::WHAT)))?;
                    endpoints.swap_remove(at)
                };
                (owned.end)(owned.handle);
            }
            H::free(handle);
        }
        Ok(())
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

/// The node of an endpoint.
pub(crate) struct NodeOfEndpoint(*const Node);

impl From<&Node> for NodeOfEndpoint {
    fn from(node: &Node) -> Self {
        NodeOfEndpoint(node)
    }
}

impl Deref for NodeOfEndpoint {
    type Target = Node;

    fn deref(&self) -> &Node {
        // SAFETY: rmw's contract: a node outlives its endpoints.
        unsafe { &*self.0 }
    }
}

exported! {
    fn rmw_create_node(
        context: *mut rmw_context_t,
        name: *const c_char => node_name,
        namespace: *const c_char => namespace,
    ) -> *mut rmw_node_t {
        // SAFETY: rmw's contract.
        let behind = unsafe { behind(context)? };
        behind.check()?;
        let handle = behind.participant.create_node_in_enclave(name, namespace, &behind.enclave)?;
        let full_name = format!("{}/{name}", namespace.trim_end_matches('/'));
        behind.system.check_node(&full_name)?;
        let participant = behind.participant.for_node(&handle);
        let signal = Arc::<Signal>::default();
        behind.watch_graph(&signal);
        let graph_guard = guard::create(context, signal)?;
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
    }

    fn rmw_destroy_node(handle: *mut rmw_node_t) {
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
    }

    fn rmw_node_get_graph_guard_condition(node: *const rmw_node_t => behind) -> *const rmw_guard_condition_t {
        Ok(node.graph_guard)
    }
}
