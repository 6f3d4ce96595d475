// SPDX-License-Identifier: MIT OR Apache-2.0
//! The event functions. When tracing is off, each costs one relaxed load and a branch that is not taken.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::event::{Event, EventKind, MessageId, ObjectId, gid_key};
use crate::init::SamplerObject;
#[cfg(feature = "lttng")]
use crate::lttng;
use crate::thread::{self, EventSink};
use tautline_rt::clock::monotonic_ns;

/// Whether events are recorded: in this process's rings, or by LTTng where that is compiled in.
///
/// # Real-time
/// Wait-free; no allocation; no syscall.
#[inline(always)]
pub fn is_on() -> bool {
    cfg!(feature = "lttng") || thread::is_on()
}

/// Records, if rings record.
#[inline(always)]
fn record(kind: EventKind, object: ObjectId, arguments: impl FnOnce() -> [u64; 3]) {
    if thread::is_on() {
        push(kind, object, arguments());
    }
}

/// Records in the current thread's ring.
#[cold]
#[inline(never)]
fn push(kind: EventKind, object: ObjectId, arguments: [u64; 3]) {
    if object == ObjectId::NONE {
        return;
    }
    match thread::place() {
        EventSink::Ring(ring) => {
            ring.push(Event { time_ns: monotonic_ns(), kind, object, arguments }.words())
        }
        EventSink::Counted(unrecorded) => {
            unrecorded.fetch_add(1, crate::sync::Ordering::Relaxed);
        }
        EventSink::Nowhere => {}
    }
}

/// `publisher` is about to send a message.
///
/// # Real-time
/// Wait-free; no allocation; no syscall, except in the first event of a thread that has not been
/// [registered](crate::register_thread).
#[inline(always)]
pub fn publish(publisher: ObjectId, message: &MessageId) {
    record(EventKind::Publish, publisher, || message.arguments());
    #[cfg(feature = "lttng")]
    lttng::publish(publisher, message);
}

/// `subscription` has taken a message.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn take(subscription: ObjectId, message: &MessageId) {
    record(EventKind::Take, subscription, || message.arguments());
    #[cfg(feature = "lttng")]
    lttng::take(subscription, message);
}

/// A mirror has received a message from a network, which it is about to publish through `publisher`.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn receive(publisher: ObjectId, message: &MessageId) {
    record(EventKind::Receive, publisher, || message.arguments());
}

/// A mirror is about to forward message `from_number` of the publisher `from` through a sender or publisher, as
/// message `sequence_number` of the latter.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn pass(through: ObjectId, sequence_number: u64, from: [u64; 2], from_number: u64) {
    record(EventKind::Pass, through, || [sequence_number, from_number, gid_key(from)]);
}

/// `callback` starts with a message or tick that was released at `release_ns` on `CLOCK_MONOTONIC`.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn callback_start(callback: ObjectId, release_ns: u64) {
    record(EventKind::CallbackStart, callback, || [release_ns, 0, 0]);
    #[cfg(feature = "lttng")]
    lttng::callback_start(callback);
}

/// `callback` has ended. `used_ns` is the processor time that its thread used for it, if that was measured.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn callback_end(callback: ObjectId, used_ns: Option<u64>) {
    record(EventKind::CallbackEnd, callback, || [used_ns.unwrap_or(0), 0, 0]);
    #[cfg(feature = "lttng")]
    lttng::callback_end(callback);
}

/// `sampler` starts to wait, at most until the absolute time `until_ns` on `CLOCK_MONOTONIC`.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn spin_start(sampler: &SamplerObject, until_ns: Option<u64>) {
    if is_on() {
        let timeout_ns = until_ns.map_or(u64::MAX, |until| until.saturating_sub(monotonic_ns()));
        record(EventKind::SpinStart, sampler.id(), || [timeout_ns, 0, 0]);
        #[cfg(feature = "lttng")]
        lttng::spin_start(sampler.node(), timeout_ns);
    }
}

/// `sampler` has something to serve.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn spin_wake(sampler: &SamplerObject) {
    record(EventKind::SpinWake, sampler.id(), || [0; 3]);
    #[cfg(feature = "lttng")]
    lttng::spin_wake(sampler.node());
}

/// The wait of `sampler` timed out.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn spin_timeout(sampler: &SamplerObject) {
    record(EventKind::SpinTimeout, sampler.id(), || [0; 3]);
    #[cfg(feature = "lttng")]
    lttng::spin_timeout(sampler.node());
}

/// `sampler` has served what it woke for.
///
/// # Real-time
/// As [`publish`].
#[inline(always)]
pub fn spin_end(sampler: &SamplerObject) {
    record(EventKind::SpinEnd, sampler.id(), || [0; 3]);
    #[cfg(feature = "lttng")]
    lttng::spin_end(sampler.node());
}
