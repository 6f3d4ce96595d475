// SPDX-License-Identifier: MIT OR Apache-2.0
//! The events as LTTng-UST tracepoints: the functions of `lttng/provider.c`.

use crate::event::{MessageId, ObjectId};
use std::cell::Cell;
use std::ffi::{CString, c_char, c_void};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use tautline_rt::fork::ProcessMutex;

/// The release of ros2_tracing whose names and fields these are.
const RELEASE: &std::ffi::CStr = c"8.4.0";
/// What ros2_tracing keeps of a gid, in bytes.
const GID_BYTES: usize = 24;

unsafe extern "C" {
    fn taut_lttng_context_init(context: u64, release: *const c_char);
    fn taut_lttng_node_init(node: u64, name: *const c_char, space: *const c_char);
    fn taut_lttng_publisher_init(
        publisher: u64,
        node: u64,
        topic: *const c_char,
        depth: usize,
        gid: *const u8,
    );
    fn taut_lttng_subscription_init(
        subscription: u64,
        node: u64,
        topic: *const c_char,
        depth: usize,
        gid: *const u8,
    );
    fn taut_lttng_subscription_callback_init(subscription: u64, callback: u64, name: *const c_char);
    fn taut_lttng_timer_init(timer: u64, node: u64, period_ns: i64);
    fn taut_lttng_timer_callback_init(timer: u64, callback: u64, name: *const c_char);
    safe fn taut_lttng_publish(publisher: u64, message: *const c_void, timestamp_ns: i64);
    safe fn taut_lttng_take(subscription: u64, message: *const c_void, source_timestamp_ns: i64);
    safe fn taut_lttng_callback_start(callback: u64);
    safe fn taut_lttng_callback_end(callback: u64);
    safe fn taut_lttng_spin_start(node: u64, timeout_s: u64, timeout_ns: u32);
    safe fn taut_lttng_spin_wake(node: u64);
    safe fn taut_lttng_spin_timeout(node: u64);
    safe fn taut_lttng_spin_end(node: u64);
}

/// A name as C has it: up to its first zero byte.
fn c(name: &str) -> CString {
    let name = name.split('\0').next().unwrap_or_default();
    CString::new(name).unwrap_or_default()
}

fn gid_bytes([low, high]: [u64; 2]) -> [u8; GID_BYTES] {
    let mut bytes = [0; GID_BYTES];
    for (to, from) in bytes.iter_mut().zip(low.to_le_bytes().into_iter().chain(high.to_le_bytes())) {
        *to = from;
    }
    bytes
}

pub(crate) fn context_init(context: ObjectId) {
    // SAFETY: a string that ends with a zero byte and lives until the call returns.
    unsafe { taut_lttng_context_init(context.0, RELEASE.as_ptr()) }
}

/// The first node of each context that has a sampler.
static NODES: ProcessMutex<Vec<(ObjectId, Weak<AtomicU64>)>> = ProcessMutex::new(Vec::new(), Vec::new);

/// The first node of `context`, zero until it is made.
pub(crate) fn node_of(context: ObjectId) -> Arc<AtomicU64> {
    let mut nodes = NODES.lock();
    nodes.retain(|(_, node)| node.strong_count() != 0);
    let node = Arc::default();
    nodes.push((context, Arc::downgrade(&node)));
    node
}

pub(crate) fn node_init(context: ObjectId, node: ObjectId, name: &str, namespace: &str) {
    let (name, namespace) = (c(name), c(namespace));
    // SAFETY: strings that end with a zero byte and live until the call returns.
    unsafe { taut_lttng_node_init(node.0, name.as_ptr(), namespace.as_ptr()) }
    for (of, first) in NODES.lock().iter() {
        if let Some(first) = first.upgrade().filter(|_| *of == context) {
            let _ = first.compare_exchange(0, node.0, Ordering::Relaxed, Ordering::Relaxed);
        }
    }
}

pub(crate) fn publisher_init(publisher: ObjectId, node: ObjectId, topic: &str, depth: usize, gid: [u64; 2]) {
    let (topic, gid) = (c(topic), gid_bytes(gid));
    // SAFETY: as above; the gid has as many bytes as the tracepoint copies.
    unsafe { taut_lttng_publisher_init(publisher.0, node.0, topic.as_ptr(), depth, gid.as_ptr()) }
}

pub(crate) fn subscription_init(subscription: ObjectId, node: ObjectId, topic: &str, depth: usize) {
    let (topic, gid) = (c(topic), gid_bytes([0; 2]));
    // SAFETY: as above.
    unsafe { taut_lttng_subscription_init(subscription.0, node.0, topic.as_ptr(), depth, gid.as_ptr()) }
}

pub(crate) fn subscription_callback_init(subscription: ObjectId, callback: ObjectId, name: &str) {
    let name = c(name);
    // SAFETY: a string that ends with a zero byte and lives until the call returns.
    unsafe { taut_lttng_subscription_callback_init(subscription.0, callback.0, name.as_ptr()) }
}

pub(crate) fn timer_init(timer: ObjectId, node: ObjectId, period_ns: u64) {
    // SAFETY: numbers only.
    unsafe { taut_lttng_timer_init(timer.0, node.0, i64::try_from(period_ns).unwrap_or(i64::MAX)) }
}

pub(crate) fn timer_callback_init(timer: ObjectId, callback: ObjectId, name: &str) {
    let name = c(name);
    // SAFETY: a string that ends with a zero byte and lives until the call returns.
    unsafe { taut_lttng_timer_callback_init(timer.0, callback.0, name.as_ptr()) }
}

#[inline]
pub(crate) fn publish(publisher: ObjectId, message: &MessageId) {
    let body = std::ptr::without_provenance(message.address);
    taut_lttng_publish(publisher.0, body, message.source_timestamp_ns);
}

#[inline]
pub(crate) fn take(subscription: ObjectId, message: &MessageId) {
    let body = std::ptr::without_provenance(message.address);
    taut_lttng_take(subscription.0, body, message.source_timestamp_ns);
}

thread_local! {
    /// The callback that runs in this thread. Tools for ROS 2 know one at a time.
    static RUNNING: Cell<ObjectId> = const { Cell::new(ObjectId::NONE) };
}

/// Ends the callback that ran before: its stream learns only when it is next polled that its item has been dealt with.
#[inline]
pub(crate) fn callback_start(callback: ObjectId) {
    if callback == ObjectId::NONE || callback.is_callback_of_nothing() {
        return;
    }
    let before = RUNNING.try_with(|running| running.replace(callback)).unwrap_or_default();
    if before != ObjectId::NONE {
        taut_lttng_callback_end(before.0);
    }
    taut_lttng_callback_start(callback.0);
}

#[inline]
pub(crate) fn callback_end(callback: ObjectId) {
    let running = RUNNING.try_with(Cell::get).unwrap_or_default();
    if callback != ObjectId::NONE && callback == running {
        RUNNING.set(ObjectId::NONE);
        taut_lttng_callback_end(callback.0);
    }
}

#[inline]
pub(crate) fn spin_start(node: ObjectId, timeout_ns: u64) {
    let (seconds, nanoseconds) = (timeout_ns / 1_000_000_000, (timeout_ns % 1_000_000_000) as u32);
    if node != ObjectId::NONE {
        taut_lttng_spin_start(node.0, seconds, nanoseconds);
    }
}

#[inline]
pub(crate) fn spin_wake(node: ObjectId) {
    if node != ObjectId::NONE {
        taut_lttng_spin_wake(node.0);
    }
}

#[inline]
pub(crate) fn spin_timeout(node: ObjectId) {
    if node != ObjectId::NONE {
        taut_lttng_spin_timeout(node.0);
    }
}

#[inline]
pub(crate) fn spin_end(node: ObjectId) {
    if node != ObjectId::NONE {
        taut_lttng_spin_end(node.0);
    }
}
