// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tests of the RMW's contract, called as by rcl: with C structs and type supports of ROS's packages.

use crate::bindings::*;
use crate::error::answer;
use crate::{
    client, context, distro, event, graph, guard, node, options, publisher, qos, serialization, service,
    subscription, types, wait,
};
use rustix::process::{Pid, Signal, WaitOptions, kill_process, waitpid};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::ffi::{CStr, c_char, c_void};
use std::ptr::{null, null_mut};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::channel;
use std::sync::{Arc, Barrier, Mutex};
use tautline_rt::Policy;
use tautline_rt::permission::{realtime_permitted, test_needs};
use tautline_transport::RawLoan;

/// Counts a thread's allocations.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller's contract.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

const NO_TIME: rmw_time_t = rmw_time_t { sec: 0, nsec: 0 };
const PATIENCE: rmw_time_t = rmw_time_t { sec: 60, nsec: 0 };

/// `geometry_msgs/msg/Point`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Point {
    x: f64,
    y: f64,
    z: f64,
}

fn support(package: &str, name: &str) -> *const rosidl_message_type_support_t {
    let library = format!("lib{package}__rosidl_typesupport_c.so");
    let symbol = format!("rosidl_typesupport_c__get_message_type_support_handle__{package}__msg__{name}");
    // SAFETY: a library of ROS's, which is never unloaded; functions of this name take nothing and give a constant.
    unsafe {
        let library = Box::leak(Box::new(libloading::Library::new(library).expect("a package of ROS's")));
        let get: libloading::Symbol<unsafe extern "C" fn() -> *const rosidl_message_type_support_t> =
            library.get(symbol.as_bytes()).expect("a message of the package's");
        get()
    }
}

fn service_support(package: &str, name: &str) -> *const rosidl_service_type_support_t {
    let library = format!("lib{package}__rosidl_typesupport_c.so");
    let symbol = format!("rosidl_typesupport_c__get_service_type_support_handle__{package}__srv__{name}");
    // SAFETY: as above.
    unsafe {
        let library = Box::leak(Box::new(libloading::Library::new(library).expect("a package of ROS's")));
        let get: libloading::Symbol<unsafe extern "C" fn() -> *const rosidl_service_type_support_t> =
            library.get(symbol.as_bytes()).expect("a service of the package's");
        get()
    }
}

/// The error text, which is then reset.
fn said() -> String {
    // SAFETY: no conditions; the struct has a text that ends with a zero.
    unsafe {
        let said = rcutils_get_error_string();
        let text = CStr::from_ptr(said.str_.as_ptr()).to_string_lossy().into_owned();
        rcutils_reset_error();
        text
    }
}

/// A node of a context of its own.
struct World {
    /// Nothing of which is left when it is dropped, unless the node [joined](World::join) another one's.
    domain: Option<u32>,
    context: Box<rmw_context_t>,
    node: *mut rmw_node_t,
}

fn options(domain: usize) -> rmw_init_options_t {
    // SAFETY: rmw's protocol.
    unsafe {
        let mut options = rmw_get_zero_initialized_init_options();
        let allocator = rcutils_get_default_allocator();
        assert_eq!(options::rmw_init_options_init(&mut options, allocator), RET_OK);
        options.enclave = rcutils_strdup(c"/".as_ptr(), allocator);
        options.domain_id = domain;
        options
    }
}

impl World {
    /// In a domain that no other test uses.
    fn new(domain: usize) -> Self {
        tautline_rt::domain::test_scope("test");
        // SAFETY: rmw's protocol.
        unsafe {
            let mut options = options(domain);
            let mut context = Box::new(rmw_get_zero_initialized_context());
            assert_eq!(context::rmw_init(&options, &mut *context), RET_OK, "{}", said());
            assert_eq!(options::rmw_init_options_fini(&mut options), RET_OK);
            let node = node::rmw_create_node(&mut *context, c"node".as_ptr(), c"/".as_ptr());
            assert!(!node.is_null(), "{}", said());
            World { domain: Some(domain as u32), context, node }
        }
    }

    /// In the domain of another one, which ends later.
    fn join(domain: usize) -> Self {
        let mut world = World::new(domain);
        world.domain = None;
        world
    }

    fn publisher(
        &self,
        of: *const rosidl_message_type_support_t,
        profile: &rmw_qos_profile_t,
    ) -> *mut rmw_publisher_t {
        // SAFETY: rmw's protocol.
        unsafe {
            let options = rmw_get_default_publisher_options();
            publisher::rmw_create_publisher(self.node, of, c"/topic".as_ptr(), profile, &options)
        }
    }

    fn subscription(
        &self,
        of: *const rosidl_message_type_support_t,
        profile: &rmw_qos_profile_t,
    ) -> *mut rmw_subscription_t {
        // SAFETY: rmw's protocol.
        unsafe {
            let options = rmw_get_default_subscription_options();
            subscription::rmw_create_subscription(self.node, of, c"/topic".as_ptr(), profile, &options)
        }
    }
}

impl Drop for World {
    fn drop(&mut self) {
        // SAFETY: rmw's protocol.
        unsafe {
            assert_eq!(node::rmw_destroy_node(self.node), RET_OK);
            assert_eq!(context::rmw_context_fini(&mut *self.context), RET_INVALID_ARGUMENT, "not shut down");
            assert_eq!(context::rmw_shutdown(&mut *self.context), RET_OK);
            assert_eq!(context::rmw_context_fini(&mut *self.context), RET_OK);
        }
        let Some(domain) = self.domain else { return };
        let folder = std::path::Path::new("/dev/shm").join(tautline_rt::domain::shared_folder(domain));
        let left = std::fs::read_dir(&folder).into_iter().flatten().map(|file| file.unwrap().file_name());
        // The process's traces are in its first domain, as long as it is in any.
        let left: Vec<_> = left.filter(|name| !name.to_string_lossy().starts_with("trace_p")).collect();
        assert!(left.is_empty() || std::thread::panicking(), "{}: {left:?}", folder.display());
    }
}

fn profile(depth: usize) -> rmw_qos_profile_t {
    rmw_qos_profile_t {
        history: RMW_QOS_POLICY_HISTORY_KEEP_LAST,
        depth,
        reliability: RMW_QOS_POLICY_RELIABILITY_RELIABLE,
        durability: RMW_QOS_POLICY_DURABILITY_VOLATILE,
        liveliness: RMW_QOS_POLICY_LIVELINESS_AUTOMATIC,
        ..rmw_qos_profile_t::default()
    }
}

/// Waits for one subscription and some guard conditions. Returns which are ready.
unsafe fn wait_for(
    set: *mut rmw_wait_set_t,
    subscription: *mut c_void,
    guards: &mut [*mut c_void],
    timeout: *const rmw_time_t,
) -> (rmw_ret_t, bool) {
    let mut subscribers = [subscription];
    let count = usize::from(!subscription.is_null());
    let mut subscriptions =
        rmw_subscriptions_t { subscriber_count: count, subscribers: subscribers.as_mut_ptr() };
    let mut guards =
        rmw_guard_conditions_t { guard_condition_count: guards.len(), guard_conditions: guards.as_mut_ptr() };
    // SAFETY: rmw's protocol.
    let answer = unsafe {
        wait::rmw_wait(&mut subscriptions, &mut guards, null_mut(), null_mut(), null_mut(), set, timeout)
    };
    (answer, !subscribers[0].is_null())
}

#[test]
fn what_is_null_unknown_or_somebody_elses_is_an_error_with_a_text() {
    let world = World::new(69);
    let of = support("geometry_msgs", "Point");
    // SAFETY: rmw's protocol, but for what is refused.
    unsafe {
        assert_eq!(context::rmw_init(null(), null_mut()), RET_INVALID_ARGUMENT);
        assert!(said().contains("options"));
        assert!(node::rmw_create_node(null_mut(), c"a".as_ptr(), c"/".as_ptr()).is_null());
        assert!(said().contains("context"));
        for (name, namespace) in [(c"a b", c"/"), (c"", c"/"), (c"a", c"b"), (c"a", c"/b/")] {
            let context: *const rmw_context_t = &*world.context;
            assert!(node::rmw_create_node(context.cast_mut(), name.as_ptr(), namespace.as_ptr()).is_null());
            assert!(said().contains("name"), "{name:?} {namespace:?}");
        }
        assert!(world.publisher(null(), &profile(1)).is_null());
        assert!(said().contains("type support"));
        for (change, what) in [
            (rmw_qos_profile_t { reliability: 99, ..profile(1) }, "reliability is 99"),
            (
                rmw_qos_profile_t { durability: RMW_QOS_POLICY_DURABILITY_UNKNOWN, ..profile(1) },
                "durability is 3",
            ),
            (rmw_qos_profile_t { history: RMW_QOS_POLICY_HISTORY_UNKNOWN, ..profile(1) }, "history is 3"),
            (rmw_qos_profile_t { liveliness: 2, ..profile(1) }, "liveliness is 2"),
        ] {
            assert!(world.publisher(of, &change).is_null() && said().contains(what), "{what}");
            assert!(world.subscription(of, &change).is_null() && said().contains(what), "{what}");
        }
        let mut of_others = *world.node;
        of_others.implementation_identifier = c"rmw_other".as_ptr();
        let mut count = 0;
        let counted = graph::rmw_count_publishers(&of_others, c"/topic".as_ptr(), &mut count);
        assert_eq!((counted, said().contains("rmw_other")), (RET_INCORRECT_RMW_IMPLEMENTATION, true));
        assert_eq!(
            graph::rmw_count_publishers(world.node, c"topic".as_ptr(), &mut count),
            RET_INVALID_ARGUMENT
        );
        assert!(said().contains("name"));
        let (no, mut allocator) = (rcutils_allocator_t::default(), rcutils_get_default_allocator());
        for (mut allocator, answer) in [(no, RET_INVALID_ARGUMENT), (allocator, RET_NODE_NAME_NON_EXISTENT)] {
            let mut names = rmw_get_zero_initialized_names_and_types();
            let services = graph::rmw_get_service_names_and_types_by_node;
            let (absent, root) = (c"absent".as_ptr(), c"/".as_ptr());
            assert_eq!(services(world.node, &mut allocator, absent, root, &mut names), answer, "{}", said());
        }
        allocator.reallocate = None;
        let mut names = rmw_get_zero_initialized_names_and_types();
        let listed = graph::rmw_get_service_names_and_types(world.node, &mut allocator, &mut names);
        assert_eq!(listed, RET_OK, "there are none: {}", said());
        said();
        assert_eq!(publisher::rmw_publish(null(), null(), null_mut()), RET_INVALID_ARGUMENT);
        assert_eq!(client::rmw_send_request(null(), null(), null_mut()), RET_INVALID_ARGUMENT);
        assert_eq!(guard::rmw_trigger_guard_condition(null()), RET_INVALID_ARGUMENT);
        let is_older = ["humble", "jazzy"].contains(&env!("RMW_INTERFACE"));
        let null_argument = if is_older { RET_ERROR } else { RET_INVALID_ARGUMENT };
        assert_eq!(wait::rmw_destroy_wait_set(null_mut()), null_argument);
        assert_eq!(client::rmw_service_server_is_available(null(), null(), null_mut()), null_argument);
        let mut event = rmw_get_zero_initialized_event();
        let publisher = world.publisher(of, &profile(1));
        let kind = RMW_EVENT_MESSAGE_LOST;
        assert_eq!(event::rmw_publisher_event_init(&mut event, publisher, kind), RET_UNSUPPORTED);
        let kind = RMW_EVENT_OFFERED_DEADLINE_MISSED;
        assert_eq!(event::rmw_publisher_event_init(&mut event, publisher, kind), RET_OK);
        let mut taken = true;
        let answer = event::rmw_take_event(&event, null_mut(), &mut taken);
        assert_eq!((answer, taken), (RET_INVALID_ARGUMENT, false));
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        said();
    }
}

#[test]
fn options_that_cannot_be_kept_are_refused_with_words() {
    type Change = fn(&mut rmw_init_options_t);
    let changes: [(Change, &str); 4] = [
        (|options| options.domain_id = 233, "domain 233"),
        (|options| options.security_options.enforce_security = RMW_SECURITY_ENFORCEMENT_ENFORCE, "SROS 2"),
        (
            |options| options.discovery_options.automatic_discovery_range = RMW_AUTOMATIC_DISCOVERY_RANGE_OFF,
            "TAUT_SCOPE",
        ),
        (|options| options.implementation_identifier = c"rmw_other".as_ptr(), "rmw_other"),
    ];
    for (change, what) in changes {
        let mut options = options(68);
        change(&mut options);
        // SAFETY: rmw's protocol.
        unsafe {
            let mut context = rmw_get_zero_initialized_context();
            assert_ne!(context::rmw_init(&options, &mut context), RET_OK, "{what}");
            let said = said();
            assert!(said.contains(what), "{said}");
            options.implementation_identifier = crate::handle::IDENTIFIER.as_ptr();
            assert_eq!(options::rmw_init_options_fini(&mut options), RET_OK);
        }
    }
}

#[test]
fn messages_are_written_and_read_in_place() {
    let world = World::new(70);
    let of = support("geometry_msgs", "Point");
    // SAFETY: rmw's protocol.
    unsafe {
        let (publisher, subscription) =
            (world.publisher(of, &profile(10)), world.subscription(of, &profile(10)));
        assert!((*publisher).can_loan_messages && (*subscription).can_loan_messages);
        let sent: Vec<Point> = (0..5).map(|n| Point { x: n.into(), y: 0.5, z: -1.0 }).collect();
        for point in &sent {
            let mut message = null_mut();
            assert_eq!(
                publisher::rmw_borrow_loaned_message(publisher, of, &mut message),
                RET_OK,
                "{}",
                said()
            );
            assert_eq!(message.cast::<Point>().read(), Point::default(), "it is initialised");
            message.cast::<Point>().write(*point);
            assert_eq!(publisher::rmw_publish_loaned_message(publisher, message, null_mut()), RET_OK);
            assert_eq!(
                publisher::rmw_publish_loaned_message(publisher, message, null_mut()),
                RET_INVALID_ARGUMENT
            );
        }
        said();
        let mut loans = Vec::new();
        for point in &sent {
            let (mut message, mut taken, mut info) =
                (null_mut(), false, rmw_get_zero_initialized_message_info());
            let answer = subscription::rmw_take_loaned_message_with_info(
                subscription,
                &mut message,
                &mut taken,
                &mut info,
                null_mut(),
            );
            assert_eq!((answer, taken), (RET_OK, true));
            assert_eq!(message.cast::<Point>().read(), *point);
            assert!(info.source_timestamp > 0 && info.received_timestamp >= info.source_timestamp);
            loans.push(message);
        }
        for message in loans {
            assert_eq!(
                subscription::rmw_return_loaned_message_from_subscription(subscription, message),
                RET_OK
            );
            assert_eq!(
                subscription::rmw_return_loaned_message_from_subscription(subscription, message),
                RET_ERROR
            );
        }
        // One that is given back unsent, and one that its publisher takes along.
        for is_given_back in [true, false] {
            let mut message = null_mut();
            assert_eq!(publisher::rmw_borrow_loaned_message(publisher, of, &mut message), RET_OK);
            if is_given_back {
                assert_eq!(publisher::rmw_return_loaned_message_from_publisher(publisher, message), RET_OK);
            }
        }
        let (mut message, mut taken) = (null_mut(), true);
        let answer =
            subscription::rmw_take_loaned_message(subscription, &mut message, &mut taken, null_mut());
        assert_eq!((answer, taken, message), (RET_OK, false, null_mut()));
        said();
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
    }
}

/// A large one is the sample itself until it is freed, resized or taken into again; only so many are; they outlive their subscription.
#[test]
fn serialized_messages_are_lent() {
    const DATA: usize = 64 << 10;
    const MOST: usize = types::HELD / 2;
    let world = World::new(75);
    let other = World::join(75);
    let of = support("std_msgs", "UInt8MultiArray");
    let message_of = |value: u8| {
        let mut bytes = vec![0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        bytes.extend((DATA as u32).to_le_bytes());
        bytes.resize(bytes.len() + DATA, value);
        bytes
    };
    // SAFETY: rmw's protocol.
    unsafe {
        let (publisher, subscription) =
            (other.publisher(of, &profile(100)), world.subscription(of, &profile(100)));
        let allocator = rcutils_get_default_allocator();
        let empty = || rmw_serialized_message_t { allocator, ..rmw_serialized_message_t::default() };
        let publish = |publisher, value: u8| {
            let mut bytes = message_of(value);
            let (buffer, len) = (bytes.as_mut_ptr(), bytes.len());
            let message =
                rmw_serialized_message_t { buffer, buffer_length: len, buffer_capacity: len, allocator };
            let answer = publisher::rmw_publish_serialized_message(publisher, &message, null_mut());
            assert_eq!(answer, RET_OK);
        };
        let match_with = |publisher| {
            let mut count = 0;
            while count == 0 {
                publisher::rmw_publisher_count_matched_subscriptions(publisher, &mut count);
                std::thread::yield_now();
            }
        };
        let take = |message: &mut rmw_serialized_message_t| {
            let mut taken = false;
            while !taken {
                let answer =
                    subscription::rmw_take_serialized_message(subscription, message, &mut taken, null_mut());
                assert_eq!(answer, RET_OK);
            }
        };
        let bytes = |message: &rmw_serialized_message_t| {
            std::slice::from_raw_parts(message.buffer, message.buffer_length).to_vec()
        };
        let is_lent = |message: &rmw_serialized_message_t| message.buffer.addr() % 64 == 60;
        match_with(publisher);
        (0..=MOST as u8 + 3).for_each(|value| publish(publisher, value));

        let mut messages: Vec<_> = std::iter::repeat_with(empty).take(MOST + 1).collect();
        messages.iter_mut().for_each(take);
        for (value, message) in messages.iter().enumerate() {
            assert_eq!(is_lent(message), value < MOST, "{value}");
            assert!(bytes(message) == message_of(value as u8), "{value}");
        }
        // One that is copied to, with room, and one that had a sample.
        take(&mut messages[MOST]);
        assert!(!is_lent(&messages[MOST]) && bytes(&messages[MOST]) == message_of(MOST as u8 + 1));
        take(&mut messages[0]);
        assert!(is_lent(&messages[0]) && bytes(&messages[0]) == message_of(MOST as u8 + 2));
        // More room, and another message: neither is the sample's memory.
        let more = messages[1].buffer_length + 1;
        assert_eq!(rcutils_uint8_array_resize(&mut messages[1], more), RET_OK);
        assert!(!is_lent(&messages[1]) && bytes(&messages[1])[..more - 1] == message_of(1));
        let text = Point { x: 1.0, y: 2.0, z: 3.0 };
        let point = support("geometry_msgs", "Point");
        assert_eq!(serialization::rmw_serialize((&raw const text).cast(), point, &mut messages[2]), RET_OK);
        assert!(!is_lent(&messages[2]));
        take(&mut messages[3]);
        assert!(is_lent(&messages[3]));

        // Neither is what the own context published, which it could write to, nor anything if that is not allowed.
        let own = world.publisher(of, &profile(100));
        match_with(own);
        for (publisher, is_allowed) in [(own, true), (publisher, false)] {
            crate::lend::allow(is_allowed);
            publish(publisher, 99);
            take(&mut messages[5]);
            assert!(!is_lent(&messages[5]) && bytes(&messages[5]) == message_of(99));
        }
        crate::lend::allow(true);
        assert_eq!(publisher::rmw_destroy_publisher(world.node, own), RET_OK);

        assert_eq!(publisher::rmw_destroy_publisher(other.node, publisher), RET_OK);
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
        assert!(bytes(&messages[4]) == message_of(4));
        for message in &messages {
            let rcutils_allocator_t { deallocate, state, .. } = message.allocator;
            deallocate.unwrap()(message.buffer.cast(), state);
        }
    }
}

/// Invalid messages, also with an invalid bool, are dropped; later ones are taken.
#[test]
fn what_is_no_message_is_dropped_and_ends_nobody() {
    let world = World::new(71);
    let of = support("std_msgs", "Bool");
    // SAFETY: rmw's protocol.
    unsafe {
        let (publisher, subscription) =
            (world.publisher(of, &profile(10)), world.subscription(of, &profile(10)));
        let publish = |bytes: &mut [u8]| {
            let serialized = rmw_serialized_message_t {
                buffer: bytes.as_mut_ptr(),
                buffer_length: bytes.len(),
                buffer_capacity: bytes.len(),
                allocator: rcutils_get_default_allocator(),
            };
            publisher::rmw_publish_serialized_message(publisher, &serialized, null_mut())
        };
        for round in 0..2 {
            // Nothing, 7, and true: in either order of bytes.
            assert_eq!(publish(&mut [0, 1, 0, 0]), RET_OK);
            assert_eq!(publish(&mut [0, 1, 0, 0, 7]), RET_OK);
            assert_eq!(publish(&mut [0, u8::from(round == 0), 0, 0, 1]), RET_OK);
            let mut taken = false;
            if round == 0 {
                let mut message = null_mut();
                let answer =
                    subscription::rmw_take_loaned_message(subscription, &mut message, &mut taken, null_mut());
                assert_eq!((answer, taken, message.cast::<u8>().read()), (RET_OK, true, 1));
                assert_eq!(
                    subscription::rmw_return_loaned_message_from_subscription(subscription, message),
                    RET_OK
                );
            } else {
                let mut message = false;
                let place: *mut bool = &mut message;
                let answer = subscription::rmw_take(subscription, place.cast(), &mut taken, null_mut());
                assert_eq!((answer, taken, message), (RET_OK, true, true));
            }
        }
        for bytes in [&mut [][..], &mut [9, 9, 9, 9, 1], &mut [0, 0, 0, 0]] {
            assert_eq!(publish(bytes), RET_ERROR, "{bytes:?}");
            assert!(!said().is_empty());
        }
        let mut bytes = [0, 1, 0, 0];
        let serialized = rmw_serialized_message_t {
            buffer: bytes.as_mut_ptr(),
            buffer_length: bytes.len(),
            buffer_capacity: bytes.len(),
            allocator: rcutils_get_default_allocator(),
        };
        let mut message = false;
        let place: *mut bool = &mut message;
        assert_eq!(serialization::rmw_deserialize(&serialized, of, place.cast()), RET_ERROR);
        assert!(said().contains("cannot be read"));
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
    }
}

#[test]
fn a_wait_ends_by_what_is_ready_by_a_trigger_from_elsewhere_or_by_its_time() {
    let mut world = World::new(72);
    let of = support("geometry_msgs", "Point");
    // SAFETY: rmw's protocol.
    unsafe {
        let set = wait::rmw_create_wait_set(&mut *world.context, 0);
        let guards = [(); 2].map(|()| guard::rmw_create_guard_condition(&mut *world.context));
        let data = guards.map(|guard| (*guard).data);
        let subscription = world.subscription(of, &profile(1));
        let publisher = world.publisher(of, &profile(1));
        let behind = (*subscription).data;
        let mut all = data;
        assert_eq!(wait_for(set, behind, &mut all, &NO_TIME), (RET_TIMEOUT, false));
        assert_eq!(all, [null_mut(); 2], "what is not ready is null, also when the time is over");

        // Set before the wait, and reset by it.
        assert_eq!(guard::rmw_trigger_guard_condition(guards[1]), RET_OK);
        all = data;
        assert_eq!(wait_for(set, behind, &mut all, &PATIENCE), (RET_OK, false));
        assert_eq!(all, [null_mut(), data[1]]);
        all = data;
        assert_eq!(wait_for(set, behind, &mut all, &NO_TIME), (RET_TIMEOUT, false));

        // While it waits, again and again: each trigger ends one wait.
        let (barrier, guard) = (Barrier::new(2), guards[0] as usize);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for _ in 0..2000 {
                    barrier.wait();
                    assert_eq!(
                        guard::rmw_trigger_guard_condition(guard as *const rmw_guard_condition_t),
                        RET_OK
                    );
                }
            });
            for _ in 0..2000 {
                barrier.wait();
                let mut all = data;
                assert_eq!(wait_for(set, behind, &mut all, null()), (RET_OK, false));
                assert_eq!(all, [data[0], null_mut()]);
            }
        });

        // Data is ready until it is taken.
        let point = Point { x: 1.0, ..Point::default() };
        let place: *const Point = &point;
        assert_eq!(publisher::rmw_publish(publisher, place.cast(), null_mut()), RET_OK);
        for _ in 0..2 {
            assert_eq!(wait_for(set, behind, &mut [], null()), (RET_OK, true));
        }
        let (mut found, mut taken) = (Point::default(), false);
        let place: *mut Point = &mut found;
        assert_eq!(subscription::rmw_take(subscription, place.cast(), &mut taken, null_mut()), RET_OK);
        assert_eq!((taken, found), (true, point));
        assert_eq!(wait_for(set, behind, &mut [], &NO_TIME), (RET_TIMEOUT, false));

        for guard in guards {
            assert_eq!(guard::rmw_destroy_guard_condition(guard), RET_OK);
        }
        assert_eq!(wait::rmw_destroy_wait_set(set), RET_OK);
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
    }
}

/// The graph shows an endpoint before it is connected: who looked in between looks again.
#[test]
fn a_match_triggers_the_graph_guard_condition() {
    let (mut world, other) = (World::new(225), World::join(225));
    let of = support("geometry_msgs", "Point");
    // SAFETY: rmw's protocol.
    unsafe {
        let set = wait::rmw_create_wait_set(&mut *world.context, 0);
        let guard = node::rmw_node_get_graph_guard_condition(world.node);
        let subscription = world.subscription(of, &profile(1));
        let wait_for_publishers = |wanted: usize| loop {
            let mut count = 0;
            let counted = subscription::rmw_subscription_count_matched_publishers(subscription, &mut count);
            assert_eq!(counted, RET_OK);
            if count == wanted {
                return;
            }
            let waited = wait_for(set, null_mut(), &mut [(*guard).data], &PATIENCE);
            assert_eq!(
                waited,
                (RET_OK, false),
                "{count} publishers, and nothing says that there are {wanted}"
            );
        };
        for _ in 0..200 {
            let publisher = other.publisher(of, &profile(1));
            wait_for_publishers(1);
            assert_eq!(publisher::rmw_destroy_publisher(other.node, publisher), RET_OK);
            wait_for_publishers(0);
        }
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
        assert_eq!(wait::rmw_destroy_wait_set(set), RET_OK);
    }
}

/// As rclpy does with its type description service: others see neither the node nor its endpoints, and the context's end leaves nothing.
#[test]
fn endpoints_that_are_not_destroyed_end_with_their_node() {
    let mut world = World::new(76);
    let (of, service_type) = (support("geometry_msgs", "Point"), service_support("std_srvs", "Empty"));
    // SAFETY: rmw's protocol, but for what is not destroyed.
    unsafe {
        let first = world.node;
        world.node = node::rmw_create_node(&mut *world.context, c"forgetful".as_ptr(), c"/".as_ptr());
        let name = c"/service".as_ptr();
        type Count = unsafe extern "C" fn(*const rmw_node_t, *const c_char, *mut usize) -> rmw_ret_t;
        let all = || {
            let counts: [(Count, &CStr); 4] = [
                (graph::rmw_count_publishers, c"/topic"),
                (graph::rmw_count_subscribers, c"/topic"),
                (graph::rmw_count_services, c"/service"),
                (graph::rmw_count_clients, c"/service"),
            ];
            counts.map(|(count, name)| {
                let mut counted = 0;
                assert_eq!(count(first, name.as_ptr(), &mut counted), RET_OK, "{}", said());
                counted
            })
        };
        let publisher = world.publisher(of, &profile(1));
        assert!(!publisher.is_null() && !world.subscription(of, &profile(1)).is_null());
        let server = service::rmw_create_service(world.node, service_type, name, &profile(1));
        let client = client::rmw_create_client(world.node, service_type, name, &profile(1));
        assert!(!server.is_null() && !client.is_null(), "{}", said());
        assert_eq!(all(), [1; 4]);
        assert_eq!(publisher::rmw_destroy_publisher(first, publisher), RET_INVALID_ARGUMENT);
        assert!(said().contains("another node"));
        assert_eq!(node::rmw_destroy_node(std::mem::replace(&mut world.node, first)), RET_OK);
        assert_eq!(all(), [0; 4]);
        let taken = service::rmw_take_request(server, null_mut(), null_mut(), null_mut());
        assert!(taken == RET_INVALID_ARGUMENT && said().contains("service is null"));
        let (mut names, mut namespaces) = Default::default();
        assert_eq!(graph::rmw_get_node_names(first, &mut names, &mut namespaces), RET_OK, "{}", said());
        assert_eq!(names.size, 1);
        assert_eq!(rcutils_string_array_fini(&mut names), RET_OK);
        assert_eq!(rcutils_string_array_fini(&mut namespaces), RET_OK);
    }
}

/// Another distribution's structs differ: nothing is written to them.
#[test]
fn another_distribution_is_refused_by_name() {
    const BUILT: &str = env!("ROS_DISTRO");
    const INTERFACE: &str = env!("RMW_INTERFACE");
    assert!(distro::check_loaded(INTERFACE, BUILT).is_ok() && distro::check_loaded(INTERFACE, "").is_ok());
    assert!(distro::check().is_ok(), "the librmw of the tests is that of the build");
    for (loaded, sourced, why) in [
        ("humbler", "", "the librmw that is loaded is of humbler"),
        ("humbler", BUILT, "the librmw that is loaded is of humbler"),
        (INTERFACE, "humbler", "ROS_DISTRO is humbler"),
    ] {
        assert_eq!(answer(|| distro::check_loaded(loaded, sourced)), RET_UNSUPPORTED);
        let fix = "build it with humbler sourced, or use another RMW";
        let expected = format!("this rmw_tautline is built for ROS 2 {BUILT}, and {why}: {fix}");
        let said = said();
        assert!(said.starts_with(&expected), "{said}");
    }
}

/// Where type supports have neither, as Humble's, a type's description and its hash follow from its struct.
#[test]
fn a_type_without_a_description_has_the_same_hash() {
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH").expect("a ROS 2 is sourced");
    let mut of_each = [0, 0];
    for share in std::env::split_paths(&prefixes).map(|prefix| prefix.join("share")) {
        let packages = std::fs::read_dir(share).unwrap().map(|entry| entry.unwrap().path());
        for (package, (kind, found)) in packages.flat_map(|package| {
            ["msg", "srv"].into_iter().enumerate().map(move |(index, kind)| (package.clone(), (kind, index)))
        }) {
            let definitions = std::fs::read_dir(package.join(kind))
                .into_iter()
                .flatten()
                .map(|entry| entry.unwrap().path());
            let definitions =
                definitions.filter(|path| path.extension().is_some_and(|ending| ending == kind));
            let package = package.file_name().unwrap().to_str().unwrap().to_owned();
            for name in definitions.map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned()) {
                // SAFETY: type supports of ROS's, in each of which there is introspection.
                let (described, expected) = unsafe {
                    let of = distro::introspection::SUPPORTS[0].as_ptr();
                    if kind == "msg" {
                        let support = support(&package, &name);
                        let members = (*get_message_typesupport_handle(support, of)).data.cast();
                        (
                            distro::introspection::message(&*members),
                            types::MessageType::of(support).unwrap().topic_type,
                        )
                    } else {
                        let support = service_support(&package, &name);
                        let members = (*get_service_typesupport_handle(support, of)).data.cast();
                        (
                            distro::introspection::service(&*members),
                            types::ServiceSupport::of(support).unwrap().service_type.request,
                        )
                    }
                };
                let schema = tautline_schema::Schema::from_description(&described).unwrap();
                assert_eq!(
                    (schema.name().to_string(), Some(schema.hash().to_string())),
                    (expected.name.into(), expected.hash.map(String::from)),
                    "{package}/{name}"
                );
                of_each[found] += 1;
            }
        }
    }
    println!("{of_each:?} messages and services");
    assert!(of_each[0] > 100 && of_each[1] > 20, "{of_each:?}");
}

/// Waits of a context end when it is shut down, and there are none after that, whatever they wait for.
#[test]
fn a_shutdown_ends_waits() {
    // Keeps the domain.
    let _world = World::new(78);
    let (waiting, shut_down) = (Arc::new(Barrier::new(4)), Arc::new(AtomicBool::new(false)));
    let (ended, ends) = channel();
    // SAFETY: rmw's protocol.
    unsafe {
        let context = Box::leak(Box::new(rmw_get_zero_initialized_context()));
        let mut options = options(78);
        assert_eq!(context::rmw_init(&options, context), RET_OK, "{}", said());
        assert_eq!(options::rmw_init_options_fini(&mut options), RET_OK);
        let context: *mut rmw_context_t = context;
        let sets: Vec<usize> = (0..3).map(|_| wait::rmw_create_wait_set(context, 0) as usize).collect();
        let guard = guard::rmw_create_guard_condition(context) as usize;
        // Threads of their own, so that a test of what does not end ends.
        for set in sets.clone() {
            let (waiting, shut_down, ended) = (waiting.clone(), shut_down.clone(), ended.clone());
            std::thread::spawn(move || {
                waiting.wait();
                while !shut_down.load(Ordering::SeqCst) {
                    let mut guards = [(*(guard as *mut rmw_guard_condition_t)).data];
                    let waited = wait_for(set as *mut rmw_wait_set_t, null_mut(), &mut guards, null());
                    assert_eq!((waited, guards), ((RET_OK, false), [null_mut()]));
                }
                let waited = wait_for(set as *mut rmw_wait_set_t, null_mut(), &mut [], &PATIENCE);
                ended.send(waited).unwrap();
            });
        }
        waiting.wait();
        shut_down.store(true, Ordering::SeqCst);
        assert_eq!(context::rmw_shutdown(context), RET_OK);
        for _ in &sets {
            let waited = ends.recv_timeout(std::time::Duration::from_secs(30)).expect("the wait has ended");
            assert_eq!(waited, (RET_TIMEOUT, false));
        }
        assert!(node::rmw_create_node(context, c"late".as_ptr(), c"/".as_ptr()).is_null());
        assert!(said().contains("shut down"));
        for set in sets {
            assert_eq!(wait::rmw_destroy_wait_set(set as *mut rmw_wait_set_t), RET_OK);
        }
        assert_eq!(guard::rmw_destroy_guard_condition(guard as *mut rmw_guard_condition_t), RET_OK);
        assert_eq!(context::rmw_context_fini(context), RET_OK);
        drop(Box::from_raw(context));
    }
}

/// What a thread of the parent has locked at a fork stays locked in the child, which is told that nothing here is its own.
#[test]
fn a_forked_child_waits_for_no_lock_of_its_parent() {
    unsafe extern "C" {
        fn fork() -> i32;
        fn _exit(status: i32) -> !;
    }
    let world = World::new(197);
    let (of, mut byte, mut number) = (service_support("std_srvs", "Empty"), 0u8, 0);
    let message: *mut c_void = (&raw mut byte).cast();
    let (locked, unlocked) = (Barrier::new(2), Barrier::new(2));
    // SAFETY: rmw's protocol; the child ends itself, and neither it nor anyone else uses its copy of what it destroys.
    unsafe {
        let client = client::rmw_create_client(world.node, of, c"/service".as_ptr(), &profile(1));
        let end = crate::handle::behind(client).unwrap().end();
        let status = std::thread::scope(|scope| {
            scope.spawn(|| {
                end.with(|_| {
                    locked.wait();
                    unlocked.wait();
                });
            });
            locked.wait();
            let child = fork();
            if child == 0 {
                let sent = client::rmw_send_request(client, message, &mut number);
                let destroyed = client::rmw_destroy_client(world.node, client);
                _exit(i32::from((sent, destroyed) != (RET_ERROR, RET_OK)));
            }
            let child = Pid::from_raw(child).expect("fork");
            let patience = std::time::Instant::now() + std::time::Duration::from_secs(30);
            let status = loop {
                if let Some((_, status)) = waitpid(Some(child), WaitOptions::NOHANG).unwrap() {
                    break status;
                }
                if std::time::Instant::now() > patience {
                    kill_process(child, Signal::KILL).unwrap();
                }
                std::thread::yield_now();
            };
            unlocked.wait();
            status
        });
        assert_eq!(status.exit_status(), Some(0));
        assert_eq!(client::rmw_destroy_client(world.node, client), RET_OK);
    }
}

/// All of it: errors before warnings, each with its policy.
#[test]
fn what_is_incompatible_is_explained() {
    let explained = |offered: rmw_qos_profile_t, requested: rmw_qos_profile_t| {
        let (mut compatibility, mut reason) = (RMW_QOS_COMPATIBILITY_OK, [c_char::default(); 2048]);
        let (room, text) = (reason.len(), reason.as_mut_ptr());
        // SAFETY: rmw's protocol; the text ends with a zero.
        unsafe {
            let check = qos::rmw_qos_profile_check_compatible;
            assert_eq!(check(offered, requested, &mut compatibility, text, room), RET_OK, "{}", said());
            (compatibility, CStr::from_ptr(text).to_string_lossy().into_owned())
        }
    };
    let of = |reliability, durability| rmw_qos_profile_t { reliability, durability, ..profile(1) };
    let (best_effort, volatile) =
        (RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT, RMW_QOS_POLICY_DURABILITY_VOLATILE);
    let latched = of(RMW_QOS_POLICY_RELIABILITY_RELIABLE, RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL);
    let refused = |policy: &str| format!("ERROR: the offered {policy} does not meet the requested one;");
    let open =
        |policy: &str| format!("WARNING: {policy} is a system default or unknown, and may be incompatible;");
    let (error, warning) = (RMW_QOS_COMPATIBILITY_ERROR, RMW_QOS_COMPATIBILITY_WARNING);
    let all = [refused("reliability"), refused("durability")].join(" ");
    assert_eq!(explained(of(best_effort, volatile), latched), (error, all));
    let (default, unknown) = (RMW_QOS_POLICY_RELIABILITY_SYSTEM_DEFAULT, RMW_QOS_POLICY_DURABILITY_UNKNOWN);
    let both = [refused("reliability"), open("durability")].join(" ");
    assert_eq!(explained(of(best_effort, unknown), latched), (error, both));
    let both = [open("reliability"), open("durability")].join(" ");
    assert_eq!(explained(latched, of(default, unknown)), (warning, both));
    let best = of(RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE, RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE);
    assert_eq!(explained(best, latched), (RMW_QOS_COMPATIBILITY_OK, String::new()));
}

/// As rmw_dds_common: a publisher offers what all subscriptions request, a subscription requests the least that publishers offer.
#[test]
fn best_available_policies_follow_from_the_others() {
    let world = World::new(79);
    let of = support("geometry_msgs", "Point");
    let seconds = |sec| rmw_time_t { sec, nsec: 0 };
    let (none, open) = (
        rmw_time_t { sec: 9_223_372_036, nsec: 854_775_807 },
        rmw_time_t { sec: 9_223_372_036, nsec: 854_775_806 },
    );
    let best = rmw_qos_profile_t {
        reliability: RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE,
        durability: RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE,
        liveliness: RMW_QOS_POLICY_LIVELINESS_BEST_AVAILABLE,
        deadline: open,
        liveliness_lease_duration: open,
        ..profile(1)
    };
    let (manual, automatic) =
        (RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC, RMW_QOS_POLICY_LIVELINESS_AUTOMATIC);
    let with = |liveliness, deadline, lease| rmw_qos_profile_t {
        liveliness,
        deadline: seconds(deadline),
        liveliness_lease_duration: seconds(lease),
        ..profile(1)
    };
    // Zero is no limit.
    let others = [with(automatic, 0, 0), with(manual, 3, 50), with(automatic, 2, 70)];
    let said_of = |qos: rmw_qos_profile_t| {
        let times = [qos.deadline, qos.liveliness_lease_duration].map(|time| (time.sec, time.nsec));
        (qos.reliability, qos.durability, qos.liveliness, times)
    };
    let (reliable, volatile) = (RMW_QOS_POLICY_RELIABILITY_RELIABLE, RMW_QOS_POLICY_DURABILITY_VOLATILE);
    let kept = RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL;
    let limits = |deadline, lease| [(deadline, 0), (lease, 0)];
    let unlimited = [(none.sec, none.nsec); 2];
    // SAFETY: rmw's protocol.
    unsafe {
        let offered = || {
            let (publisher, mut actual) = (world.publisher(of, &best), rmw_qos_profile_t::default());
            assert_eq!(publisher::rmw_publisher_get_actual_qos(publisher, &mut actual), RET_OK, "{}", said());
            let mut count = 0;
            let counted = publisher::rmw_publisher_count_matched_subscriptions(publisher, &mut count);
            assert_eq!(counted, RET_OK);
            assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
            (said_of(actual), count)
        };
        let requested = || {
            let (subscription, mut actual) = (world.subscription(of, &best), rmw_qos_profile_t::default());
            let got = subscription::rmw_subscription_get_actual_qos(subscription, &mut actual);
            assert_eq!(got, RET_OK, "{}", said());
            assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
            said_of(actual)
        };
        assert_eq!(offered(), ((reliable, kept, automatic, unlimited), 0));
        assert_eq!(requested(), (reliable, kept, manual, unlimited));
        let subscriptions = others.map(|qos| world.subscription(of, &qos));
        assert_eq!(offered(), ((reliable, kept, manual, limits(2, 50)), 3));
        for subscription in subscriptions {
            assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
        }
        let publishers = others.map(|qos| world.publisher(of, &qos));
        assert_eq!(requested(), (reliable, volatile, automatic, limits(3, 70)));
        for publisher in publishers {
            assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        }
    }
}

/// `std_msgs/msg/UInt8` as if an IDL file defined its field as `char`, or `UInt16` as `wchar`.
#[repr(C)]
struct Letter {
    support: rosidl_message_type_support_t,
    hash: rosidl_type_hash_t,
    description: rosidl_runtime_c__type_description__TypeDescription,
}

impl Letter {
    /// Lives as long as the process, as type supports do.
    unsafe fn support(name: &str, type_id: u8, field_name: &CStr) -> *const rosidl_message_type_support_t {
        unsafe extern "C" fn find(
            support: *const rosidl_message_type_support_t,
            _: *const c_char,
        ) -> *const rosidl_message_type_support_t {
            support
        }
        unsafe extern "C" fn hash(
            support: *const rosidl_message_type_support_t,
        ) -> *const rosidl_type_hash_t {
            // SAFETY: the first field of a letter. Also below.
            unsafe { &(*support.cast::<Letter>()).hash }
        }
        unsafe extern "C" fn description(
            support: *const rosidl_message_type_support_t,
        ) -> *const rosidl_runtime_c__type_description__TypeDescription {
            // SAFETY: as above.
            unsafe { &(*support.cast::<Letter>()).description }
        }
        // SAFETY: a support of ROS's, of which the structs are kept.
        unsafe {
            let number = support("std_msgs", name);
            let number = get_message_typesupport_handle(number, c"rosidl_typesupport_fastrtps_c".as_ptr());
            let mut description_of = *(*number).get_type_description_func.unwrap()(number);
            let mut field = *description_of.type_description.fields.data;
            field.type_.type_id = type_id;
            field.name.data = field_name.to_owned().into_raw();
            field.name.size = field_name.count_bytes();
            description_of.type_description.fields.data = Box::into_raw(Box::new(field));
            let hash_of = distro::described(&description_of).hash().to_string();
            let support = rosidl_message_type_support_t {
                func: Some(find),
                get_type_hash_func: Some(hash),
                get_type_description_func: Some(description),
                ..*number
            };
            let hash = distro::type_hash(Some(&hash_of));
            &Box::leak(Box::new(Letter { support, hash, description: description_of })).support
        }
    }
}

#[test]
fn characters_and_names_of_idl_files_are_sent() {
    for (name, type_id, field_name, letter) in
        [("UInt8", 13, c"data", 97u16), ("UInt16", 14, c"lambda", 8364), ("UInt16", 5, c"frameId", 7)]
    {
        let world = World::new(77);
        // SAFETY: rmw's protocol; such a message is one or two bytes.
        unsafe {
            let of = Letter::support(name, type_id, field_name);
            let (publisher, subscription) =
                (world.publisher(of, &profile(5)), world.subscription(of, &profile(5)));
            assert!(!publisher.is_null() && !subscription.is_null(), "{}", said());
            let (mut found, mut taken) = (0u16, false);
            assert_eq!(publisher::rmw_publish(publisher, (&raw const letter).cast(), null_mut()), RET_OK);
            let place = (&raw mut found).cast();
            assert_eq!(subscription::rmw_take(subscription, place, &mut taken, null_mut()), RET_OK);
            assert_eq!((taken, found), (true, letter), "{}", said());
            assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
            assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
        }
    }
}

/// C's structs may be uninitialised: invalid bools are sent as true, as Fast CDR does.
#[test]
fn a_bool_that_is_none_is_sent_as_true() {
    let world = World::new(83);
    let of = support("std_msgs", "Bool");
    // SAFETY: rmw's protocol; such a message is a byte.
    unsafe {
        let (publisher, subscription) =
            (world.publisher(of, &profile(5)), world.subscription(of, &profile(5)));
        for (sent, expected) in [(0u8, 0u8), (1, 1), (238, 1)] {
            let (mut found, mut taken) = (7u8, false);
            assert_eq!(publisher::rmw_publish(publisher, (&raw const sent).cast(), null_mut()), RET_OK);
            let place = (&raw mut found).cast();
            assert_eq!(subscription::rmw_take(subscription, place, &mut taken, null_mut()), RET_OK);
            assert_eq!((taken, found), (true, expected), "{}", said());
        }
        let mut lent: *mut c_void = null_mut();
        assert_eq!(publisher::rmw_borrow_loaned_message(publisher, of, &mut lent), RET_OK);
        lent.cast::<u8>().write(2);
        assert_eq!(publisher::rmw_publish_loaned_message(publisher, lent, null_mut()), RET_OK);
        let (mut found, mut taken) = (7u8, false);
        assert_eq!(
            subscription::rmw_take(subscription, (&raw mut found).cast(), &mut taken, null_mut()),
            RET_OK
        );
        assert_eq!((taken, found), (true, 1));
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
    }
}

/// Sends five requests through a client and a server with these depths. Returns which requests the server takes, and which
/// responses the client.
fn taken_of_five(domain: usize, server_depth: usize, client_depth: usize) -> (Vec<i64>, Vec<i64>) {
    let world = World::new(domain);
    let of = service_support("std_srvs", "Empty");
    let mut byte = 0u8;
    let message: *mut c_void = (&raw mut byte).cast();
    // SAFETY: rmw's protocol; requests and responses are one byte.
    unsafe {
        let (served, asking) = (profile(server_depth), profile(client_depth));
        let server = service::rmw_create_service(world.node, of, c"/service".as_ptr(), &served);
        let client = client::rmw_create_client(world.node, of, c"/service".as_ptr(), &asking);
        assert!(!server.is_null() && !client.is_null(), "{}", said());
        for expected in 1..=5 {
            let mut number = 0;
            assert_eq!(client::rmw_send_request(client, message, &mut number), RET_OK, "{}", said());
            assert_eq!(number, expected);
        }
        let all = |take: &dyn Fn(&mut rmw_service_info_t, &mut bool) -> rmw_ret_t| {
            let mut numbers = Vec::new();
            loop {
                let (mut header, mut taken) = (rmw_service_info_t::default(), false);
                assert_eq!(take(&mut header, &mut taken), RET_OK);
                if !taken {
                    return numbers;
                }
                numbers.push(header.request_id);
            }
        };
        let requests = all(&|header, taken| service::rmw_take_request(server, header, message, taken));
        for request in &requests {
            assert_eq!(service::rmw_send_response(server, &mut request.clone(), message), RET_OK);
        }
        let responses = all(&|header, taken| client::rmw_take_response(client, header, message, taken));
        assert_eq!(client::rmw_destroy_client(world.node, client), RET_OK);
        assert_eq!(service::rmw_destroy_service(world.node, server), RET_OK);
        let numbers = |ids: Vec<rmw_request_id_t>| ids.iter().map(|id| id.sequence_number).collect();
        (numbers(requests), numbers(responses))
    }
}

/// A depth below ROS's default is a limit; otherwise bursts are kept.
#[test]
fn services_and_clients_keep_as_much_as_they_are_asked_to() {
    assert_eq!(taken_of_five(80, 2, 10), (vec![4, 5], vec![4, 5]));
    assert_eq!(taken_of_five(81, 10, 2), (vec![1, 2, 3, 4, 5], vec![4, 5]));
    assert_eq!(taken_of_five(82, 0, 0), (vec![1, 2, 3, 4, 5], vec![1, 2, 3, 4, 5]));
}

/// Sends requests of two clients in several orders to a server of this depth, which is to take the newest.
fn take_newest_of_two_clients(domain: usize, depth: usize) {
    let world = World::new(domain);
    let of = service_support("std_srvs", "Empty");
    let mut byte = 0u8;
    let message: *mut c_void = (&raw mut byte).cast();
    // SAFETY: rmw's protocol; requests are one byte.
    unsafe {
        let server = service::rmw_create_service(world.node, of, c"/service".as_ptr(), &profile(depth));
        let client = || client::rmw_create_client(world.node, of, c"/service".as_ptr(), &profile(10));
        let clients = [client(), client()];
        let send = |client: usize| {
            let mut number = 0;
            assert_eq!(client::rmw_send_request(clients[client], message, &mut number), RET_OK, "{}", said());
            number
        };
        let take = || {
            let (mut header, mut taken) = (rmw_service_info_t::default(), false);
            assert_eq!(service::rmw_take_request(server, &mut header, message, &mut taken), RET_OK);
            taken.then_some((header.request_id.writer_guid, header.request_id.sequence_number))
        };
        let gids = [0, 1].map(|client| {
            send(client);
            take().unwrap().0
        });
        for order in [[0, 0, 1, 1], [1, 1, 0, 0], [0, 1, 1, 0], [1, 0, 0, 1]] {
            let sent = order.map(|client| (gids[client], send(client)));
            assert_eq!(std::iter::from_fn(take).collect::<Vec<_>>(), sent[4 - depth..], "{order:?}");
        }
        for client in clients {
            assert_eq!(client::rmw_destroy_client(world.node, client), RET_OK);
        }
        assert_eq!(service::rmw_destroy_service(world.node, server), RET_OK);
    }
}

#[test]
fn the_newest_requests_of_several_clients_are_kept() {
    for (domain, depth) in [(37, 1), (40, 2), (41, 3)] {
        take_newest_of_two_clients(domain, depth);
    }
}

/// All samples of its publisher are in use, as if /dev/shm were full for a while.
#[test]
fn a_waiting_request_that_could_not_be_sent_is_sent_again() {
    let world = World::new(39);
    let of = service_support("std_srvs", "Empty");
    let mut byte = 0u8;
    let message: *mut c_void = (&raw mut byte).cast();
    // SAFETY: rmw's protocol; requests are one byte.
    unsafe {
        let client = client::rmw_create_client(world.node, of, c"/service".as_ptr(), &profile(10));
        let mut number = 0;
        assert_eq!(client::rmw_send_request(client, message, &mut number), RET_OK, "{}", said());
        let end = (*(*client).data.cast::<client::Client>()).end();
        let loans: Vec<_> = end.with(|asking| {
            // Dropped below, before the client, by this thread.
            let loan = |_| std::mem::transmute::<RawLoan<'_>, RawLoan<'static>>(asking.raw.loan(1).unwrap());
            (0..types::HELD).map(loan).collect()
        });
        let server = service::rmw_create_service(world.node, of, c"/service".as_ptr(), &profile(10));
        wait_until(|| end.with(|asking| asking.has_failed));
        end.with(|_| drop(loans));
        let mut taken = false;
        wait_until(|| {
            let mut header = rmw_service_info_t::default();
            assert_eq!(service::rmw_take_request(server, &mut header, message, &mut taken), RET_OK);
            taken
        });
        assert_eq!(client::rmw_destroy_client(world.node, client), RET_OK);
        assert_eq!(service::rmw_destroy_service(world.node, server), RET_OK);
    }
}

/// More wait sets than a context has thread bells: the helper wakes the last ones, and nothing is missed.
#[test]
fn wait_sets_have_no_limit() {
    let mut world = World::new(73);
    let of = support("geometry_msgs", "Point");
    // SAFETY: rmw's protocol.
    unsafe {
        let sets: Vec<_> =
            (0..400).map(|_| wait::rmw_create_wait_set(&mut *world.context, 0) as usize).collect();
        let subscription = world.subscription(of, &profile(1));
        let publisher = world.publisher(of, &profile(1)) as usize;
        let last = *sets.last().unwrap() as *mut rmw_wait_set_t;
        let barrier = Barrier::new(2);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for n in 0..500 {
                    barrier.wait();
                    let point = Point { x: n.into(), ..Point::default() };
                    let place: *const Point = &point;
                    let publisher = publisher as *const rmw_publisher_t;
                    assert_eq!(publisher::rmw_publish(publisher, place.cast(), null_mut()), RET_OK);
                }
            });
            for n in 0..500 {
                barrier.wait();
                assert_eq!(wait_for(last, (*subscription).data, &mut [], null()), (RET_OK, true));
                let (mut found, mut taken) = (Point::default(), false);
                let place: *mut Point = &mut found;
                assert_eq!(
                    subscription::rmw_take(subscription, place.cast(), &mut taken, null_mut()),
                    RET_OK
                );
                assert_eq!((taken, found.x), (true, n.into()));
            }
        });
        for set in sets {
            assert_eq!(wait::rmw_destroy_wait_set(set as *mut rmw_wait_set_t), RET_OK);
        }
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher as *mut rmw_publisher_t), RET_OK);
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
    }
}

/// A node that waits no longer, and another one that begins to.
#[test]
fn a_wait_set_gets_no_bell_that_is_rung_for_another_ones_endpoints() {
    let mut world = World::new(38);
    let of = support("geometry_msgs", "Point");
    // SAFETY: rmw's protocol.
    unsafe {
        let subscription = world.subscription(of, &profile(1));
        let set = wait::rmw_create_wait_set(&mut *world.context, 0);
        let soon = rmw_time_t { sec: 0, nsec: 1 };
        assert_eq!(wait_for(set, (*subscription).data, &mut [], &soon), (RET_TIMEOUT, false));
        assert_eq!(wait::rmw_destroy_wait_set(set), RET_OK);
        let context = &*world.context.impl_.cast::<context::Context>();
        let holders = || {
            let waiter = context.waiters.claim(&context.participant);
            let holders = (waiter.bell().is_some(), Arc::strong_count(&waiter));
            context.waiters.give_back(&waiter);
            holders
        };
        // The test and the list: nothing that rings it.
        assert_eq!(holders(), (true, 2));
        // rclpy makes a wait set for each wait: one that waits for the same endpoints is rung by them as they are.
        let rung = || (*(*subscription).data.cast::<subscription::Subscription>()).end().bell().unwrap();
        let former = rung();
        let set = wait::rmw_create_wait_set(&mut *world.context, 0);
        assert_eq!(wait_for(set, (*subscription).data, &mut [], &soon), (RET_TIMEOUT, false));
        assert_eq!(wait::rmw_destroy_wait_set(set), RET_OK);
        assert!(std::sync::Arc::ptr_eq(&former, &rung()));
        drop(former);
        assert_eq!(holders(), (true, 2));
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
        assert_eq!(holders(), (true, 2));
    }
}

/// After memory has been claimed, publishing, waiting and taking allocate nothing.
#[test]
fn nothing_is_allocated_on_a_messages_way() {
    let mut world = World::new(74);
    let of = support("geometry_msgs", "Point");
    // SAFETY: rmw's protocol.
    unsafe {
        let set = wait::rmw_create_wait_set(&mut *world.context, 0);
        let (publisher, subscription) =
            (world.publisher(of, &profile(10)), world.subscription(of, &profile(10)));
        let guard = guard::rmw_create_guard_condition(&mut *world.context);
        let mut round = |n: i32| {
            let point = Point { x: n.into(), ..Point::default() };
            let place: *const Point = &point;
            assert_eq!(publisher::rmw_publish(publisher, place.cast(), null_mut()), RET_OK);
            let mut guards = [(*guard).data];
            assert_eq!(wait_for(set, (*subscription).data, &mut guards, null()), (RET_OK, true));
            let (mut found, mut taken, mut info) =
                (Point::default(), false, rmw_get_zero_initialized_message_info());
            let place: *mut Point = &mut found;
            let answer = subscription::rmw_take_with_info(
                subscription,
                place.cast(),
                &mut taken,
                &mut info,
                null_mut(),
            );
            assert_eq!((answer, taken, found), (RET_OK, true, point));
            let mut message = null_mut();
            assert_eq!(publisher::rmw_borrow_loaned_message(publisher, of, &mut message), RET_OK);
            assert_eq!(publisher::rmw_publish_loaned_message(publisher, message, null_mut()), RET_OK);
            let (mut message, mut taken) = (null_mut(), false);
            let answer =
                subscription::rmw_take_loaned_message(subscription, &mut message, &mut taken, null_mut());
            assert_eq!((answer, taken), (RET_OK, true));
            assert_eq!(
                subscription::rmw_return_loaned_message_from_subscription(subscription, message),
                RET_OK
            );
            // Nothing is ready: all paths into sleep, and out of it by a flag.
            guard::rmw_trigger_guard_condition(guard);
            assert_eq!(wait_for(set, (*subscription).data, &mut [(*guard).data], &PATIENCE), (RET_OK, false));
            let time = rmw_time_t { sec: 0, nsec: 1000 };
            assert_eq!(
                wait_for(set, (*subscription).data, &mut [(*guard).data], &time),
                (RET_TIMEOUT, false)
            );
        };
        (0..100).for_each(&mut round);
        let before = ALLOCATIONS.get();
        (0..1000).for_each(&mut round);
        assert_eq!(ALLOCATIONS.get() - before, 0);
        assert_eq!(guard::rmw_destroy_guard_condition(guard), RET_OK);
        assert_eq!(wait::rmw_destroy_wait_set(set), RET_OK);
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
    }
}

/// How often the callback was called, and for how many messages in total.
#[derive(Default)]
struct Called {
    times: AtomicUsize,
    messages: AtomicUsize,
}

fn wait_until(mut is_so: impl FnMut() -> bool) {
    let end = std::time::Instant::now() + std::time::Duration::from_secs(60);
    while !is_so() {
        assert!(std::time::Instant::now() < end, "not within a minute");
        std::thread::yield_now();
    }
}

unsafe extern "C" fn note(called: *const c_void, count: usize) {
    // SAFETY: what the callback was set with, which outlives it.
    let called = unsafe { &*called.cast::<Called>() };
    called.messages.fetch_add(count, Ordering::SeqCst);
    called.times.fetch_add(1, Ordering::SeqCst);
}

/// A message's callback is called by the thread that publishes it, before that returns; by another thread if the publisher belongs to
/// another context. The same for requests and responses.
#[test]
fn callbacks_are_called_by_the_publishing_thread() {
    let (world, called) = (World::new(84), Called::default());
    let (data, of): (*const Called, _) = (&called, support("geometry_msgs", "Point"));
    let counted = || called.messages.load(Ordering::SeqCst);
    let point = Point::default();
    let place: *const Point = &point;
    // SAFETY: rmw's protocol.
    unsafe {
        let set_callback = subscription::rmw_subscription_set_on_new_message_callback;
        let (publisher, subscription) =
            (world.publisher(of, &profile(100)), world.subscription(of, &profile(100)));
        assert_eq!(set_callback(subscription, Some(note), data.cast()), RET_OK);
        let mut allocated = 0;
        for n in 1..=200 {
            // After memory has been claimed.
            let before = ALLOCATIONS.get();
            assert_eq!(publisher::rmw_publish(publisher, place.cast(), null_mut()), RET_OK);
            assert_eq!(counted(), n);
            let (mut found, mut taken) = (Point::default(), false);
            let into: *mut Point = &mut found;
            assert_eq!(subscription::rmw_take(subscription, into.cast(), &mut taken, null_mut()), RET_OK);
            assert!(taken);
            allocated += if n > 100 { ALLOCATIONS.get() - before } else { 0 };
        }
        assert_eq!(allocated, 0);
        // A second context in this process.
        let second = World::join(84);
        let other = second.publisher(of, &profile(100));
        let mut count = 0;
        wait_until(|| {
            publisher::rmw_publisher_count_matched_subscriptions(other, &mut count);
            count == 1
        });
        assert_eq!(publisher::rmw_publish(other, place.cast(), null_mut()), RET_OK);
        wait_until(|| counted() == 201);
        assert_eq!(set_callback(subscription, None, null()), RET_OK);
        for publisher in [publisher, other] {
            assert_eq!(publisher::rmw_publish(publisher, place.cast(), null_mut()), RET_OK);
        }
        assert_eq!(counted(), 201);
        assert_eq!(publisher::rmw_destroy_publisher(second.node, other), RET_OK);
        drop(second);
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);

        let (service_type, name) = (service_support("std_srvs", "Empty"), c"/service".as_ptr());
        let server = service::rmw_create_service(world.node, service_type, name, &profile(10));
        let client = client::rmw_create_client(world.node, service_type, name, &profile(10));
        let mut is_there = false;
        wait_until(|| {
            assert_eq!(client::rmw_service_server_is_available(world.node, client, &mut is_there), RET_OK);
            is_there
        });
        called.messages.store(0, Ordering::SeqCst);
        assert_eq!(service::rmw_service_set_on_new_request_callback(server, Some(note), data.cast()), RET_OK);
        assert_eq!(client::rmw_client_set_on_new_response_callback(client, Some(note), data.cast()), RET_OK);
        let (mut byte, mut number) = (0u8, 0);
        let message: *mut c_void = (&raw mut byte).cast();
        assert_eq!(client::rmw_send_request(client, message, &mut number), RET_OK, "{}", said());
        assert_eq!(counted(), 1);
        let (mut header, mut taken) = (rmw_service_info_t::default(), false);
        assert_eq!(service::rmw_take_request(server, &mut header, message, &mut taken), RET_OK);
        assert!(taken);
        assert_eq!(service::rmw_send_response(server, &mut header.request_id, message), RET_OK);
        assert_eq!(counted(), 2);
        assert_eq!(client::rmw_destroy_client(world.node, client), RET_OK);
        assert_eq!(service::rmw_destroy_service(world.node, server), RET_OK);
    }
}

/// The thread that calls callbacks for messages of other contexts has the priority of the thread that set them.
#[test]
fn callbacks_for_other_contexts_have_the_priority_of_who_set_them() {
    if test_needs(realtime_permitted(31)).is_none() {
        return;
    }
    type Found = Mutex<Option<Policy>>;
    unsafe extern "C" fn read_policy(found: *const c_void, _: usize) {
        // SAFETY: what the callback was set with, which outlives it.
        let found = unsafe { &*found.cast::<Found>() };
        *found.lock().unwrap() = tautline_rt::current_policy().ok();
    }
    let (world, other) = (World::new(86), World::join(86));
    let (found, of, point) = (Found::default(), support("geometry_msgs", "Point"), Point::default());
    let (data, place): (*const Found, *const Point) = (&found, &point);
    // SAFETY: rmw's protocol.
    unsafe {
        let (publisher, subscription) =
            (other.publisher(of, &profile(10)), world.subscription(of, &profile(10)));
        let (subscription_of_thread, data_of_thread) = (subscription as usize, data as usize);
        let set_callback = move || {
            let (subscription, data) = (subscription_of_thread as *mut _, data_of_thread as *const _);
            let set = subscription::rmw_subscription_set_on_new_message_callback;
            assert_eq!(set(subscription, Some(read_policy), data), RET_OK);
        };
        let mut count = 0;
        wait_until(|| {
            publisher::rmw_publisher_count_matched_subscriptions(publisher, &mut count);
            count == 1
        });
        let policy_of_call = || {
            *found.lock().unwrap() = None;
            assert_eq!(publisher::rmw_publish(publisher, place.cast(), null_mut()), RET_OK);
            wait_until(|| found.lock().unwrap().is_some());
            *found.lock().unwrap()
        };
        set_callback();
        assert_eq!(policy_of_call(), tautline_rt::current_policy().ok());
        std::thread::spawn(move || {
            tautline_rt::set_own_priority(31).unwrap();
            set_callback();
        })
        .join()
        .unwrap();
        assert_eq!(policy_of_call(), Some(Policy::Fifo(31)));
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
        assert_eq!(publisher::rmw_destroy_publisher(other.node, publisher), RET_OK);
    }
}

/// With several publishing threads, in two contexts, and a thread that waits for the same subscription: each message is reported once,
/// and the wait ends.
#[test]
fn callbacks_and_waits_miss_nothing_together() {
    const EACH: usize = 2_000;
    let (mut world, called) = (World::new(85), Called::default());
    let (data, of): (*const Called, _) = (&called, support("geometry_msgs", "Point"));
    // SAFETY: rmw's protocol.
    unsafe {
        let subscription = world.subscription(of, &profile(2 * EACH));
        let set_callback = subscription::rmw_subscription_set_on_new_message_callback;
        let publishers = [(); 2].map(|()| world.publisher(of, &profile(2 * EACH)) as usize);
        let set = wait::rmw_create_wait_set(&mut *world.context, 0);
        std::thread::scope(|scope| {
            for publisher in publishers {
                scope.spawn(move || {
                    let point = Point::default();
                    let place: *const Point = &point;
                    for _ in 0..EACH {
                        let publisher = publisher as *const rmw_publisher_t;
                        assert_eq!(publisher::rmw_publish(publisher, place.cast(), null_mut()), RET_OK);
                    }
                });
            }
            let mut received = 0;
            while received < 2 * EACH {
                // Also set anew while messages come.
                if received % 100 == 0 {
                    assert_eq!(set_callback(subscription, Some(note), data.cast()), RET_OK);
                }
                assert_eq!(wait_for(set, (*subscription).data, &mut [], &PATIENCE), (RET_OK, true));
                let (mut found, mut taken) = (Point::default(), false);
                let place: *mut Point = &mut found;
                assert_eq!(
                    subscription::rmw_take(subscription, place.cast(), &mut taken, null_mut()),
                    RET_OK
                );
                assert!(taken);
                received += 1;
            }
        });
        let reported = called.messages.load(Ordering::SeqCst);
        assert!(reported <= 2 * EACH, "{reported}: what was taken before it was reported is not");
        assert_eq!(wait::rmw_destroy_wait_set(set), RET_OK);
        for publisher in publishers {
            let publisher = publisher as *mut rmw_publisher_t;
            assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        }
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
    }
}

/// Each message is reported once, including earlier ones, also after a wait for the same subscription; never after the callback
/// was removed or the subscription destroyed.
#[test]
fn callbacks_are_told_of_each_message_once() {
    let mut world = World::new(75);
    let of = support("geometry_msgs", "Point");
    let called = Called::default();
    let data: *const Called = &called;
    let told = |count: usize| wait_until(|| called.messages.load(Ordering::SeqCst) == count);
    // SAFETY: rmw's protocol.
    unsafe {
        let set = wait::rmw_create_wait_set(&mut *world.context, 0);
        let (publisher, subscription) =
            (world.publisher(of, &profile(100)), world.subscription(of, &profile(100)));
        let publish = |count: i32| {
            for n in 0..count {
                let point = Point { x: n.into(), ..Point::default() };
                let place: *const Point = &point;
                assert_eq!(publisher::rmw_publish(publisher, place.cast(), null_mut()), RET_OK);
            }
        };
        let take_all = || {
            let (mut found, mut taken) = (Point::default(), true);
            while taken {
                let place: *mut Point = &mut found;
                assert_eq!(
                    subscription::rmw_take(subscription, place.cast(), &mut taken, null_mut()),
                    RET_OK
                );
            }
        };
        let set_callback = subscription::rmw_subscription_set_on_new_message_callback;
        publish(3);
        assert_eq!(set_callback(subscription, Some(note), data.cast()), RET_OK);
        assert_eq!(called.messages.load(Ordering::SeqCst), 3, "for what waits at once");
        // As with Fast DDS: each message is reported once.
        assert_eq!(set_callback(subscription, Some(note), data.cast()), RET_OK);
        publish(5);
        told(8);
        take_all();
        publish(1);
        told(9);
        take_all();
        // A wait that sleeps; the callback is called again after it.
        let time = rmw_time_t { sec: 0, nsec: 1_000_000 };
        assert_eq!(wait_for(set, (*subscription).data, &mut [], &time), (RET_TIMEOUT, false));
        publish(2);
        told(11);
        take_all();
        // Set anew, again and again.
        for n in 1..20 {
            assert_eq!(set_callback(subscription, None, null()), RET_OK);
            publish(1);
            assert_eq!(set_callback(subscription, Some(note), data.cast()), RET_OK);
            assert_eq!(called.messages.load(Ordering::SeqCst), 11 + n);
            take_all();
        }
        assert_eq!(subscription::rmw_destroy_subscription(world.node, subscription), RET_OK);
        let times = called.times.load(Ordering::SeqCst);
        publish(5);
        assert_eq!(wait::rmw_destroy_wait_set(set), RET_OK);
        assert_eq!(publisher::rmw_destroy_publisher(world.node, publisher), RET_OK);
        drop(world);
        assert_eq!(called.times.load(Ordering::SeqCst), times);
    }
}
