// SPDX-License-Identifier: MIT OR Apache-2.0
//! Ends a wait, on a trigger or a change of the graph.

use super::context::{Context, Node};
use super::error::{RclError, check};
use r2r_rcl::*;
use std::sync::Arc;

/// Ends a thread's wait, from any other thread.
pub struct GuardCondition {
    raw: *mut rcl_guard_condition_t,
    _context: Arc<Context>,
}

// SAFETY: triggering is thread-safe, and the only use before it is dropped.
unsafe impl Send for GuardCondition {}
// SAFETY: as above.
unsafe impl Sync for GuardCondition {}

impl GuardCondition {
    /// Creates a guard condition.
    pub fn new(context: &Arc<Context>) -> Result<Arc<Self>, RclError> {
        // SAFETY: rcl's protocol; boxed, because wait sets keep its address, and freed by `drop`.
        unsafe {
            let raw = Box::into_raw(Box::new(rcl_get_zero_initialized_guard_condition()));
            let options = rcl_guard_condition_get_default_options();
            let made =
                check("making a guard condition", rcl_guard_condition_init(raw, context.raw(), options));
            if let Err(error) = made {
                drop(Box::from_raw(raw));
                return Err(error);
            }
            Ok(Arc::new(GuardCondition { raw, _context: context.clone() }))
        }
    }

    /// Ends the current wait, or else the next one.
    pub fn trigger(&self) {
        // SAFETY: it is initialised until it is dropped.
        let _ = check("triggering", unsafe { rcl_trigger_guard_condition(self.raw) });
    }

    pub(crate) fn raw(&self) -> *const rcl_guard_condition_t {
        self.raw
    }
}

impl Drop for GuardCondition {
    fn drop(&mut self) {
        // SAFETY: exclusive.
        unsafe {
            let _ = rcl_guard_condition_fini(self.raw);
            drop(Box::from_raw(self.raw));
        }
    }
}

/// A change of the graph of a node, which ROS triggers.
pub struct GraphGuard {
    node: Arc<Node>,
}

impl GraphGuard {
    /// The guard of the graph that `node` sees.
    pub fn of(node: &Arc<Node>) -> Self {
        GraphGuard { node: node.clone() }
    }

    pub(crate) fn raw(&self) -> *const rcl_guard_condition_t {
        // SAFETY: the node lives, and its guard condition with it.
        unsafe { rcl_node_get_graph_guard_condition(self.node.raw()) }
    }
}
