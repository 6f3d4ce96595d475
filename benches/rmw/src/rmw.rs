// SPDX-License-Identifier: MIT OR Apache-2.0
//! An RMW as rcl calls it, by the names of its functions: whichever library is told. Nothing is freed: the process ends with it.

use crate::bindings::*;
use libloading::Library;
use std::ffi::{CStr, CString, c_char, c_void};
use std::ptr::null_mut;
use std::time::Duration;
use tautline_exchange::{Job, Result};

/// How long messages are that go as structs.
pub const STRUCT_BYTES: usize = size_of::<Twist>();

/// `geometry_msgs/msg/Twist`: six numbers.
#[repr(C)]
#[derive(Default)]
pub struct Twist(pub [f64; 6]);

impl Twist {
    pub fn place(&mut self) -> *mut c_void {
        std::ptr::from_mut(self).cast()
    }
}

pub type Publish = unsafe extern "C" fn(*const rmw_publisher_t, *const c_void, *mut c_void) -> rmw_ret_t;
pub type Take =
    unsafe extern "C" fn(*const rmw_subscription_t, *mut c_void, *mut bool, *mut c_void) -> rmw_ret_t;
type Wait = unsafe extern "C" fn(
    *mut rmw_subscriptions_t,
    *mut rmw_guard_conditions_t,
    *mut rmw_services_t,
    *mut rmw_clients_t,
    *mut rmw_events_t,
    *mut rmw_wait_set_t,
    *const rmw_time_t,
) -> rmw_ret_t;
type Create<Options, End, Support = rosidl_message_type_support_t> = unsafe extern "C" fn(
    *mut rmw_node_t,
    *const Support,
    *const c_char,
    *const rmw_qos_profile_t,
    *const Options,
) -> *mut End;

pub fn checked(code: rmw_ret_t, what: &str) -> Result<()> {
    if code == RET_OK { Ok(()) } else { Err(format!("{what}: {}", reason()).into()) }
}

fn made<T>(end: *mut T, what: &str) -> Result<*mut T> {
    if end.is_null() { Err(format!("no {what} was made: {}", reason()).into()) } else { Ok(end) }
}

/// What the RMW said last.
fn reason() -> String {
    // SAFETY: no conditions; it has a text that ends with a zero.
    unsafe {
        let said = rcutils_get_error_string();
        CStr::from_ptr(said.str_.as_ptr()).to_string_lossy().into_owned()
    }
}

/// A node with a context of its own.
pub struct Node {
    library: &'static Library,
    context: *mut rmw_context_t,
    pub node: *mut rmw_node_t,
    profile: rmw_qos_profile_t,
}

impl Node {
    /// With the library that the job's mode names.
    pub fn new(job: &Job, name: &str) -> Result<Self> {
        Self::within(RMW_AUTOMATIC_DISCOVERY_RANGE_LOCALHOST, job, name)
    }

    /// One that looks for others in this range.
    pub fn within(range: rmw_automatic_discovery_range_t, job: &Job, name: &str) -> Result<Self> {
        // SAFETY: an RMW's library, never unloaded; its functions are those of rmw's headers; rmw's protocol.
        unsafe {
            let library: &Library = Box::leak(Box::new(Library::new(&job.way.mode)?));
            let mut options = rmw_get_zero_initialized_init_options();
            let allocator = rcutils_get_default_allocator();
            type InitOptions =
                unsafe extern "C" fn(*mut rmw_init_options_t, rcutils_allocator_t) -> rmw_ret_t;
            let init_options = library.get::<InitOptions>(b"rmw_init_options_init")?;
            checked(init_options(&mut options, allocator), "options")?;
            options.enclave = rcutils_strdup(c"/".as_ptr(), allocator);
            options.domain_id = job.domain as usize;
            options.discovery_options.automatic_discovery_range = range;
            let context = Box::leak(Box::new(rmw_get_zero_initialized_context()));
            type Init = unsafe extern "C" fn(*const rmw_init_options_t, *mut rmw_context_t) -> rmw_ret_t;
            checked(library.get::<Init>(b"rmw_init")?(&options, context), "context")?;
            type CreateNode =
                unsafe extern "C" fn(*mut rmw_context_t, *const c_char, *const c_char) -> *mut rmw_node_t;
            let create = library.get::<CreateNode>(b"rmw_create_node")?;
            let name = CString::new(name)?;
            let node = made(create(context, name.as_ptr(), c"/".as_ptr()), "node")?;
            let profile = rmw_qos_profile_t {
                history: RMW_QOS_POLICY_HISTORY_KEEP_LAST,
                depth: job.depth(),
                reliability: RMW_QOS_POLICY_RELIABILITY_RELIABLE,
                durability: RMW_QOS_POLICY_DURABILITY_VOLATILE,
                liveliness: RMW_QOS_POLICY_LIVELINESS_AUTOMATIC,
                ..rmw_qos_profile_t::default()
            };
            Ok(Node { library, context, node, profile })
        }
    }

    /// The function with this name.
    ///
    /// # Safety
    /// It is of the type `F`.
    pub unsafe fn function<F: Copy>(&self, name: &str) -> Result<F> {
        // SAFETY: the caller's word.
        Ok(unsafe { *self.library.get::<F>(name.as_bytes())? })
    }

    pub fn publisher(
        &self,
        support: *const rosidl_message_type_support_t,
        topic: &str,
    ) -> Result<*mut rmw_publisher_t> {
        let topic = CString::new(topic)?;
        // SAFETY: rmw's protocol.
        unsafe {
            let settings = rmw_get_default_publisher_options();
            let create: Create<rmw_publisher_options_t, rmw_publisher_t> =
                self.function("rmw_create_publisher")?;
            made(create(self.node, support, topic.as_ptr(), &self.profile, &settings), "publisher")
        }
    }

    pub fn subscription(
        &self,
        support: *const rosidl_message_type_support_t,
        topic: &str,
    ) -> Result<*mut rmw_subscription_t> {
        let topic = CString::new(topic)?;
        // SAFETY: rmw's protocol.
        unsafe {
            let settings = rmw_get_default_subscription_options();
            let create: Create<rmw_subscription_options_t, rmw_subscription_t> =
                self.function("rmw_create_subscription")?;
            made(create(self.node, support, topic.as_ptr(), &self.profile, &settings), "subscription")
        }
    }

    pub fn service(&self, support: *const rosidl_service_type_support_t, name: &str) -> Result<()> {
        type CreateService = unsafe extern "C" fn(
            *const rmw_node_t,
            *const rosidl_service_type_support_t,
            *const c_char,
            *const rmw_qos_profile_t,
        ) -> *mut rmw_service_t;
        let name = CString::new(name)?;
        // SAFETY: rmw's protocol.
        unsafe {
            let create: CreateService = self.function("rmw_create_service")?;
            made(create(self.node, support, name.as_ptr(), &self.profile), "service").map(|_| ())
        }
    }

    /// Waits for these, in this order.
    pub fn waiting(&self, subscriptions: Vec<*mut rmw_subscription_t>) -> Result<Waiting> {
        type CreateWaitSet = unsafe extern "C" fn(*mut rmw_context_t, usize) -> *mut rmw_wait_set_t;
        // SAFETY: rmw's protocol.
        unsafe {
            let create: CreateWaitSet = self.function("rmw_create_wait_set")?;
            let wait_set = made(create(self.context, subscriptions.len()), "wait set")?;
            let ready = vec![null_mut(); subscriptions.len()];
            Ok(Waiting { wait: self.function("rmw_wait")?, wait_set, subscriptions, ready })
        }
    }
}

/// Subscriptions in a wait set.
pub struct Waiting {
    wait: Wait,
    wait_set: *mut rmw_wait_set_t,
    pub subscriptions: Vec<*mut rmw_subscription_t>,
    /// As rmw has them: null is not ready.
    ready: Vec<*mut c_void>,
}

impl Waiting {
    /// Whether any has a message, at most so long from now.
    pub fn wait(&mut self, patience: Duration) -> Result<bool> {
        let timeout = rmw_time_t { sec: patience.as_secs(), nsec: patience.subsec_nanos().into() };
        for (ready, subscription) in self.ready.iter_mut().zip(&self.subscriptions) {
            // SAFETY: never freed.
            *ready = unsafe { (**subscription).data };
        }
        let (count, none) = (self.ready.len(), null_mut());
        let mut all = rmw_subscriptions_t { subscriber_count: count, subscribers: self.ready.as_mut_ptr() };
        // SAFETY: rmw's protocol.
        let code = unsafe {
            (self.wait)(&mut all, null_mut(), null_mut(), null_mut(), none, self.wait_set, &timeout)
        };
        if code == RET_TIMEOUT {
            return Ok(false);
        }
        checked(code, "wait").map(|()| true)
    }

    pub fn is_ready(&self, index: usize) -> bool {
        !self.ready[index].is_null()
    }
}
