// SPDX-License-Identifier: MIT OR Apache-2.0
//! The common part of publishers, subscriptions, servers and clients.

use super::context::Node;
use super::error::{RclError, check};
use r2r_rcl::*;
use std::sync::Arc;

/// rcl's object of one entity, boxed because nodes and wait sets keep its address.
pub(super) struct RclEntity<T> {
    raw: *mut T,
    fini: Fini<T>,
    node: Arc<Node>,
}

type Fini<T> = unsafe extern "C" fn(*mut T, *mut rcl_node_t) -> rcl_ret_t;

// SAFETY: rcl's objects may move between threads; they are created and destroyed under the node's lock.
unsafe impl<T> Send for RclEntity<T> {}

impl<T> RclEntity<T> {
    /// Initialises `zero` with `init`. `what` names the step in an error.
    ///
    /// # Safety
    /// If `init` returns no error, it has initialised its argument as an entity of `node` that `fini` ends. What the entity
    /// refers to outlives it.
    pub(super) unsafe fn make(
        what: &'static str,
        node: &Arc<Node>,
        zero: T,
        init: impl FnOnce(*mut T) -> rcl_ret_t,
        fini: Fini<T>,
    ) -> Result<Self, RclError> {
        let _making = node.making();
        let raw = Box::into_raw(Box::new(zero));
        if let Err(error) = check(what, init(raw)) {
            // SAFETY: the box above, to which rcl keeps no pointer after an error.
            drop(unsafe { Box::from_raw(raw) });
            return Err(error);
        }
        Ok(RclEntity { raw, fini, node: node.clone() })
    }

    /// rcl's object, initialised until this is dropped.
    pub(super) fn raw(&self) -> *mut T {
        self.raw
    }

    pub(super) fn node(&self) -> &Node {
        &self.node
    }
}

impl<T> Drop for RclEntity<T> {
    fn drop(&mut self) {
        let _making = self.node.making();
        // SAFETY: initialised by `make`, exclusive, and its node lives.
        unsafe {
            let _ = (self.fini)(self.raw, self.node.raw());
            drop(Box::from_raw(self.raw));
        }
    }
}
