// SPDX-License-Identifier: MIT OR Apache-2.0
//! An RMW as rcl calls it, by the names of its functions: whichever library is told.

use crate::bindings::*;
use libloading::Library;
use std::ffi::{CString, c_void};
use std::ptr::null_mut;
use std::time::Duration;
use tautline_exchange::{Job, Link, Result};

/// Payloads up to this are structs that are written and read by their type support; longer ones are serialized messages.
pub const STRUCT_BYTES: usize = size_of::<Twist>();

/// `geometry_msgs/msg/Twist`: six numbers.
#[repr(C)]
#[derive(Default)]
struct Twist([f64; 6]);

/// Of a serialized `std_msgs/msg/UInt8MultiArray`: how it is encoded, no dimensions, no offset, the length of the data.
const HEADER_BYTES: usize = 16;

/// What is used of it.
struct Functions {
    publish: unsafe extern "C" fn(*const rmw_publisher_t, *const c_void, *mut c_void) -> rmw_ret_t,
    publish_serialized: unsafe extern "C" fn(
        *const rmw_publisher_t,
        *const rmw_serialized_message_t,
        *mut c_void,
    ) -> rmw_ret_t,
    take: unsafe extern "C" fn(*const rmw_subscription_t, *mut c_void, *mut bool, *mut c_void) -> rmw_ret_t,
    take_serialized: unsafe extern "C" fn(
        *const rmw_subscription_t,
        *mut rmw_serialized_message_t,
        *mut bool,
        *mut c_void,
    ) -> rmw_ret_t,
    wait: unsafe extern "C" fn(
        *mut rmw_subscriptions_t,
        *mut rmw_guard_conditions_t,
        *mut rmw_services_t,
        *mut rmw_clients_t,
        *mut rmw_events_t,
        *mut rmw_wait_set_t,
        *const rmw_time_t,
    ) -> rmw_ret_t,
}

/// One end of round trips. Nothing of it is freed: the process ends with it.
pub struct End {
    functions: Functions,
    publisher: *mut rmw_publisher_t,
    subscription: *mut rmw_subscription_t,
    wait_set: *mut rmw_wait_set_t,
    /// A serialized message to send, and one to take into.
    messages: Option<[rmw_serialized_message_t; 2]>,
}

fn checked(code: rmw_ret_t, what: &str) -> Result<()> {
    if code == RET_OK { Ok(()) } else { Err(format!("{what}: error {code} of the RMW").into()) }
}

impl End {
    /// With the library that the job's mode names.
    pub fn new(job: &Job) -> Result<Self> {
        // SAFETY: an RMW's library and ROS's, never unloaded; their functions are those of rmw's headers; rmw's protocol.
        unsafe {
            let rmw = Box::leak(Box::new(Library::new(&job.way.mode)?));
            let (package, name) = match job.payload_bytes <= STRUCT_BYTES {
                true => ("geometry_msgs", "Twist"),
                false => ("std_msgs", "UInt8MultiArray"),
            };
            let types = Box::leak(Box::new(Library::new(format!("lib{package}__rosidl_typesupport_c.so"))?));
            let symbol =
                format!("rosidl_typesupport_c__get_message_type_support_handle__{package}__msg__{name}");
            let support = types
                .get::<unsafe extern "C" fn() -> *const rosidl_message_type_support_t>(symbol.as_bytes())?(
            );
            let mut options = rmw_get_zero_initialized_init_options();
            let allocator = rcutils_get_default_allocator();
            type InitOptions =
                unsafe extern "C" fn(*mut rmw_init_options_t, rcutils_allocator_t) -> rmw_ret_t;
            checked(rmw.get::<InitOptions>(b"rmw_init_options_init")?(&mut options, allocator), "options")?;
            options.enclave = rcutils_strdup(c"/".as_ptr(), allocator);
            options.domain_id = job.domain as usize;
            options.discovery_options.automatic_discovery_range = RMW_AUTOMATIC_DISCOVERY_RANGE_LOCALHOST;
            let context = Box::leak(Box::new(rmw_get_zero_initialized_context()));
            type Init = unsafe extern "C" fn(*const rmw_init_options_t, *mut rmw_context_t) -> rmw_ret_t;
            checked(rmw.get::<Init>(b"rmw_init")?(&options, context), "context")?;
            type Node = unsafe extern "C" fn(*mut rmw_context_t, *const i8, *const i8) -> *mut rmw_node_t;
            let name = CString::new(format!("{:?}", job.role).to_lowercase())?;
            let node = rmw.get::<Node>(b"rmw_create_node")?(context, name.as_ptr(), c"/".as_ptr());
            let profile = rmw_qos_profile_t {
                history: RMW_QOS_POLICY_HISTORY_KEEP_LAST,
                depth: job.depth(),
                reliability: RMW_QOS_POLICY_RELIABILITY_RELIABLE,
                durability: RMW_QOS_POLICY_DURABILITY_VOLATILE,
                liveliness: RMW_QOS_POLICY_LIVELINESS_AUTOMATIC,
                ..rmw_qos_profile_t::default()
            };
            let [to, from] = job.topics().map(CString::new);
            type Publisher = unsafe extern "C" fn(
                *mut rmw_node_t,
                *const rosidl_message_type_support_t,
                *const i8,
                *const rmw_qos_profile_t,
                *const rmw_publisher_options_t,
            ) -> *mut rmw_publisher_t;
            let settings = rmw_get_default_publisher_options();
            let create = rmw.get::<Publisher>(b"rmw_create_publisher")?;
            let publisher = create(node, support, to?.as_ptr(), &profile, &settings);
            type Subscription = unsafe extern "C" fn(
                *mut rmw_node_t,
                *const rosidl_message_type_support_t,
                *const i8,
                *const rmw_qos_profile_t,
                *const rmw_subscription_options_t,
            ) -> *mut rmw_subscription_t;
            let settings = rmw_get_default_subscription_options();
            let create = rmw.get::<Subscription>(b"rmw_create_subscription")?;
            let subscription = create(node, support, from?.as_ptr(), &profile, &settings);
            type WaitSet = unsafe extern "C" fn(*mut rmw_context_t, usize) -> *mut rmw_wait_set_t;
            let wait_set = rmw.get::<WaitSet>(b"rmw_create_wait_set")?(context, 1);
            if publisher.is_null() || subscription.is_null() || wait_set.is_null() {
                return Err("the RMW made no publisher, subscription or wait set".into());
            }
            let serialized = |bytes: usize| {
                let buffer = vec![0_u8; bytes].leak();
                let (buffer_length, buffer_capacity) = (bytes, bytes);
                rmw_serialized_message_t {
                    buffer: buffer.as_mut_ptr(),
                    buffer_length,
                    buffer_capacity,
                    allocator,
                }
            };
            let messages = (job.payload_bytes > STRUCT_BYTES).then(|| {
                let out = serialized(HEADER_BYTES + job.payload_bytes);
                let bytes = std::slice::from_raw_parts_mut(out.buffer, HEADER_BYTES);
                bytes.copy_from_slice(&[0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
                bytes[12..].copy_from_slice(&(job.payload_bytes as u32).to_le_bytes());
                // ROS resizes what it takes into, by the allocator that it was made by: ample from the start.
                [out, serialized(2 * HEADER_BYTES + job.payload_bytes)]
            });
            let functions = Functions {
                publish: *rmw.get(b"rmw_publish")?,
                publish_serialized: *rmw.get(b"rmw_publish_serialized_message")?,
                take: *rmw.get(b"rmw_take")?,
                take_serialized: *rmw.get(b"rmw_take_serialized_message")?,
                wait: *rmw.get(b"rmw_wait")?,
            };
            Ok(End { functions, publisher, subscription, wait_set, messages })
        }
    }

    /// The number of the next message, if there is one.
    fn take(&mut self) -> Result<Option<u64>> {
        let mut taken = false;
        // SAFETY: rmw's protocol; as long as it was made, and longer than its header.
        unsafe {
            if let Some([_, message]) = &mut self.messages {
                let take = self.functions.take_serialized;
                checked(take(self.subscription, message, &mut taken, null_mut()), "take")?;
                let number = message.buffer.add(HEADER_BYTES).cast::<u64>().read_unaligned();
                return Ok(taken.then_some(number));
            }
            let mut message = Twist::default();
            let place: *mut Twist = &mut message;
            checked((self.functions.take)(self.subscription, place.cast(), &mut taken, null_mut()), "take")?;
            Ok(taken.then_some(message.0[0].to_bits()))
        }
    }
}

impl Link for End {
    fn send(&mut self, number: u64) -> Result<()> {
        // SAFETY: rmw's protocol; longer than its header.
        let code = unsafe {
            if let Some([message, _]) = &mut self.messages {
                message.buffer.add(HEADER_BYTES).cast::<u64>().write_unaligned(number);
                (self.functions.publish_serialized)(self.publisher, message, null_mut())
            } else {
                let message = Twist([f64::from_bits(number), 1.0, 2.0, 3.0, 4.0, 5.0]);
                let place: *const Twist = &message;
                (self.functions.publish)(self.publisher, place.cast(), null_mut())
            }
        };
        checked(code, "publish")
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        let timeout = rmw_time_t { sec: patience.as_secs(), nsec: patience.subsec_nanos().into() };
        // SAFETY: rmw's protocol.
        let code = unsafe {
            let mut subscribers = [(*self.subscription).data];
            let mut all = rmw_subscriptions_t { subscriber_count: 1, subscribers: subscribers.as_mut_ptr() };
            let (none, wait) = (null_mut(), self.functions.wait);
            wait(&mut all, null_mut(), null_mut(), null_mut(), none, self.wait_set, &timeout)
        };
        if code == RET_TIMEOUT {
            return Ok(None);
        }
        checked(code, "wait")?;
        self.take()
    }
}
