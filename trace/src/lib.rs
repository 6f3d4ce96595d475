// SPDX-License-Identifier: MIT OR Apache-2.0
//! Trace events of the hot path: when a message was published and taken, when its callback began and ended, when the sampler
//! woke.
//!
//! - The events are functions, called where the events happen: [`publish`], [`take`], [`callback_start`] ... While nothing
//!   is recorded, each costs one relaxed load and a branch.
//! - Each thread records into its own ring in shared memory, which it claims before it becomes real-time
//!   ([`register_thread`]). The writer never waits. Events that a recorder fetches too late are overwritten, and
//!   counted.
//! - A [`Recorder`], in any process of the same user, switches a domain's recording on and fetches the events. The lock of a
//!   file shows that a recorder exists, so a killed recorder leaves nothing switched on.
//! - No event of a killed process is lost: its rings remain until a recorder has fetched them.
//! - A table beside the rings describes the objects of events (nodes, topics, callbacks), so that a recorder may start late.
//! - A message that a mirror forwards gets another id: [`pass`] records both ids, so that its path can be
//!   followed.
//! - With the feature `lttng` the same functions are LTTng-UST tracepoints with the names and fields of ros2_tracing and r2r.
//!
//! ```
//! use tautline_trace::{EventKind, MessageId, Record, Recorder, TraceMode};
//!
//! tautline_trace::configure(TraceMode::On.into());
//! let membership = tautline_trace::join(1204)?; // what a Context does
//! let publisher = tautline_trace::publisher_init("/imu", 10, [1, 2]);
//! let message = MessageId { sequence_number: 1, source_timestamp_ns: 0, gid: [1, 2], address: 0 };
//! tautline_trace::publish(publisher.id(), &message);
//!
//! let mut kinds = Vec::new();
//! let recorder = Recorder::start(1204)?; // what `taut trace record` does
//! recorder.finish(&mut |record: Record<'_>| {
//!     if let Record::Events { events, .. } = record {
//!         kinds.extend(events.iter().map(|event| event.kind));
//!     }
//! });
//! assert_eq!(kinds, [EventKind::Publish]);
//! drop(membership);
//! # Ok::<(), tautline_trace::TraceError>(())
//! ```

mod control;
mod description;
mod error;
mod event;
mod hot;
mod init;
mod layout;
#[cfg(feature = "lttng")]
mod lttng;
mod object;
mod process;
mod recorder;
mod register;
mod ring;
mod settings;
mod sync;
mod thread;

pub use control::is_trace_file;
pub use description::{Description, ObjectKind};
pub use error::TraceError;
pub use event::{Event, EventKind, MessageId, ObjectId, gid_key};
pub use hot::{
    callback_end, callback_start, is_on, pass, publish, receive, spin_end, spin_start, spin_timeout,
    spin_wake, take,
};
pub use init::{
    NodeScope, SamplerObject, callback_init, context_init, in_node, node_init, publisher_init, sampler_init,
    sender_init, subscription_callback_init, subscription_init, timer_callback_init, timer_init,
};
pub use object::Object;
pub use process::{Membership, attend, configure, join, leave_at_exit};
pub use recorder::{Record, Recorder, remove_dead_files, remove_dead_files_in};
pub use register::{register_thread, register_thread_as};
pub use settings::{TraceMode, TraceSettings};
