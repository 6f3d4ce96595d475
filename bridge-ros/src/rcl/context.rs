// SPDX-License-Identifier: MIT OR Apache-2.0
//! A participant of a ROS domain, and its nodes.

use super::error::{RclError, check};
use super::publications::{self, Publications};
use r2r_rcl::*;
use std::ffi::{CStr, CString};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use tautline_rt::PiMutex;
use tautline_transport::Gid;

/// A participant of a ROS domain. With Fast DDS its threads start here.
pub struct Context {
    raw: *mut rcl_context_t,
    domain: u32,
    /// The GID prefix of its participant, once it has a publisher.
    own: OnceLock<[u8; PREFIX]>,
    /// For an RMW whose messages do not carry their publishers' GIDs.
    publications: OnceLock<PiMutex<Publications>>,
}

/// Length of the participant's prefix of a DDS GID.
const PREFIX: usize = 12;

fn prefix(gid: &Gid) -> [u8; PREFIX] {
    std::array::from_fn(|index| gid.0[index])
}

// SAFETY: rcl reads a context from many threads; only `new` and `drop` change it, with exclusive access.
unsafe impl Send for Context {}
// SAFETY: as above.
unsafe impl Sync for Context {}

impl Context {
    /// Joins `domain`; `None`: `ROS_DOMAIN_ID`.
    ///
    /// # Errors
    /// [`RclError`], usually of the RMW.
    pub fn new(domain: Option<u32>) -> Result<Arc<Self>, RclError> {
        // SAFETY: rcl's protocol: zero, initialise, use, end. The options live until `rcl_init` has copied them. The
        // context is boxed, for nodes keep its address, and freed by `drop`.
        unsafe {
            let mut options = rcl_get_zero_initialized_init_options();
            check(
                "preparing a context",
                rcl_init_options_init(&mut options, rcutils_get_default_allocator()),
            )?;
            let set = domain.map_or(Ok(()), |domain| {
                check("setting the domain", rcl_init_options_set_domain_id(&mut options, domain as usize))
            });
            let raw = Box::into_raw(Box::new(rcl_get_zero_initialized_context()));
            let started =
                set.and_then(|()| check("starting ROS 2", rcl_init(0, std::ptr::null(), &options, raw)));
            let _ = rcl_init_options_fini(&mut options);
            let mut context = Context { raw, domain: 0, own: OnceLock::new(), publications: OnceLock::new() };
            if let Err(error) = started {
                drop(Box::from_raw(raw));
                std::mem::forget(context);
                return Err(error);
            }
            let mut number = 0;
            check("reading the domain", rcl_context_get_domain_id(raw, &mut number))?;
            context.domain = u32::try_from(number).unwrap_or(u32::MAX);
            Ok(Arc::new(context))
        }
    }

    /// The domain.
    pub fn domain(&self) -> u32 {
        self.domain
    }

    /// Stores the context's GID prefix, which is that of one of its publishers.
    pub(super) fn learn_own(&self, publisher: &Gid) {
        let _ = self.own.set(prefix(publisher));
    }

    /// Whether the GID is of one of its publishers.
    pub(crate) fn is_own(&self, publisher: &Gid) -> bool {
        self.own.get() == Some(&prefix(publisher))
    }

    /// The GID of a message's publisher, from the GID that the RMW gives.
    ///
    /// # Real-time
    /// With Cyclone DDS [`Publications::gid`] under a lock that inherits priority.
    pub(super) fn publisher(&self, said: Gid) -> Gid {
        let [handle @ .., _, _, _, _, _, _, _, _] = said.0;
        self.publications.get().map_or(said, |all| all.lock().gid(u64::from_ne_bytes(handle)))
    }

    /// Reads changes of the list of publications.
    pub(crate) fn refresh(&self) {
        if let Some(publications) = self.publications.get() {
            publications.lock().refresh();
        }
    }

    /// Opens the list of publications, if needed. Call it when there is a node: the first one creates the RMW's participant.
    fn find_publications(&self) -> Result<(), RclError> {
        if self.publications.get().is_none() && rmw_implementation() == publications::RMW {
            let _ = self.publications.set(PiMutex::new(Publications::new(self.domain)?));
        }
        Ok(())
    }

    pub(crate) fn raw(&self) -> *mut rcl_context_t {
        self.raw
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // Before the RMW's participant ends.
        drop(self.publications.take());
        // SAFETY: exclusive: users hold an `Arc` of it.
        unsafe {
            let _ = rcl_shutdown(self.raw);
            let _ = rcl_context_fini(self.raw);
            drop(Box::from_raw(self.raw));
        }
    }
}

/// The RMW implementation, such as `rmw_fastrtps_cpp`.
pub fn rmw_implementation() -> String {
    // SAFETY: a constant text of the library that is linked.
    unsafe { CStr::from_ptr(rmw_get_implementation_identifier()) }.to_string_lossy().into_owned()
}

/// A node of the ROS graph.
pub struct Node {
    raw: *mut rcl_node_t,
    /// Held while an entity of the node is created or destroyed, which rcl does not support concurrently.
    making: Mutex<()>,
    context: Arc<Context>,
}

// SAFETY: rcl reads the graph from many threads; changes of the node hold `making`.
unsafe impl Send for Node {}
// SAFETY: as above.
unsafe impl Sync for Node {}

/// Nodes are created and destroyed one at a time: rcl's list of loggers is per process.
static NODES: Mutex<()> = Mutex::new(());

impl Node {
    /// Creates a node, without a publisher of `/rosout`.
    ///
    /// # Errors
    /// [`RclError`]: an invalid name.
    pub fn new(context: &Arc<Context>, name: &str, namespace: &str) -> Result<Arc<Self>, RclError> {
        let (c_name, c_namespace) = (text(name)?, text(namespace)?);
        let node = Self::make(context, &c_name, &c_namespace)?;
        context.find_publications()?;
        Ok(Arc::new(node))
    }

    fn make(context: &Arc<Context>, name: &CStr, namespace: &CStr) -> Result<Self, RclError> {
        let _making = NODES.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: rcl's protocol; the node is boxed, for publishers keep its address, and freed by `drop`.
        unsafe {
            let mut options = rcl_node_get_default_options();
            options.enable_rosout = false;
            let raw = Box::into_raw(Box::new(rcl_get_zero_initialized_node()));
            let made = rcl_node_init(raw, name.as_ptr(), namespace.as_ptr(), context.raw(), &options);
            let made = check("making a node", made);
            let _ = rcl_node_options_fini(&mut options);
            if let Err(error) = made {
                drop(Box::from_raw(raw));
                return Err(error);
            }
            Ok(Node { raw, making: Mutex::new(()), context: context.clone() })
        }
    }

    /// Its context.
    pub fn context(&self) -> &Arc<Context> {
        &self.context
    }

    pub(crate) fn raw(&self) -> *mut rcl_node_t {
        self.raw
    }

    /// The lock to hold while an entity of the node is created or destroyed.
    pub(crate) fn making(&self) -> MutexGuard<'_, ()> {
        self.making.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _making = NODES.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: exclusive: users hold an `Arc` of it.
        unsafe {
            let _ = rcl_node_fini(self.raw);
            drop(Box::from_raw(self.raw));
        }
    }
}

/// Converts a text to a C string.
pub(crate) fn text(text: &str) -> Result<CString, RclError> {
    let what = "reading a name";
    CString::new(text).map_err(|_| RclError { what, code: 0, reason: format!("{text:?} contains a NUL") })
}
