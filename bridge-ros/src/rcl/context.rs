// SPDX-License-Identifier: MIT OR Apache-2.0
//! Membership of a ROS domain, and its nodes.

use super::error::{RclError, check};
use super::publications::{self, Publications};
use r2r_rcl::*;
use std::ffi::{CStr, CString};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use tautline_rt::PiMutex;
use tautline_transport::Gid;

/// Membership of a ROS domain. With Fast DDS: one participant, whose threads start here.
pub struct Context {
    raw: *mut rcl_context_t,
    domain: u32,
    /// What the gids of its participant begin with, once it has a publisher.
    own: OnceLock<[u8; PREFIX]>,
    /// For an RMW whose messages do not tell their publishers' gids.
    publications: OnceLock<PiMutex<Publications>>,
}

/// Bytes of a DDS gid that are the participant's.
const PREFIX: usize = 12;

fn prefix(gid: &Gid) -> [u8; PREFIX] {
    std::array::from_fn(|index| gid.0[index])
}

// SAFETY: rcl reads a context from many threads; it is changed by `new` and `drop` alone, which have it for themselves.
unsafe impl Send for Context {}
// SAFETY: as above.
unsafe impl Sync for Context {}

impl Context {
    /// Joins `domain`, or the one that `ROS_DOMAIN_ID` says.
    ///
    /// # Errors
    /// [`RclError`], of the RMW most likely.
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

    /// Learns by one of its publishers what the context's gids begin with.
    pub(super) fn learn_own(&self, publisher: &Gid) {
        let _ = self.own.set(prefix(publisher));
    }

    /// Whether it is the gid of one of its publishers.
    pub(crate) fn is_own(&self, publisher: &Gid) -> bool {
        self.own.get() == Some(&prefix(publisher))
    }

    /// The gid of a message's publisher, from what the RMW says of it.
    ///
    /// # Real-time
    /// With Cyclone DDS [`Publications::gid`] under a lock that inherits priority.
    pub(super) fn publisher(&self, said: Gid) -> Gid {
        let [handle @ .., _, _, _, _, _, _, _, _] = said.0;
        self.publications.get().map_or(said, |all| all.lock().gid(u64::from_ne_bytes(handle)))
    }

    /// Takes what changed of what that is found by.
    pub(crate) fn refresh(&self) {
        if let Some(publications) = self.publications.get() {
            publications.lock().refresh();
        }
    }

    /// What that is found by, once there is a node: the first one makes the RMW's participant.
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
        // Before the RMW's own participant.
        drop(self.publications.take());
        // SAFETY: nobody else has it: what uses it holds an `Arc` of it.
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
    /// Held while something of the node is made or destroyed, which rcl does not do twice at once.
    making: Mutex<()>,
    context: Arc<Context>,
}

// SAFETY: rcl looks at the graph from many threads; what changes the node holds `making`.
unsafe impl Send for Node {}
// SAFETY: as above.
unsafe impl Sync for Node {}

/// Nodes are made and destroyed one at a time: rcl's list of loggers is the process's.
static NODES: Mutex<()> = Mutex::new(());

impl Node {
    /// Makes a node, without a publisher of `/rosout`.
    ///
    /// # Errors
    /// [`RclError`]: a name that cannot be one.
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

    /// To be held while something of the node is made or destroyed.
    pub(crate) fn making(&self) -> MutexGuard<'_, ()> {
        self.making.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _making = NODES.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: nobody else has it: what uses it holds an `Arc` of it.
        unsafe {
            let _ = rcl_node_fini(self.raw);
            drop(Box::from_raw(self.raw));
        }
    }
}

/// As C has it.
pub(crate) fn text(text: &str) -> Result<CString, RclError> {
    let what = "reading a name";
    CString::new(text).map_err(|_| RclError { what, code: 0, reason: format!("{text:?} contains a zero") })
}
