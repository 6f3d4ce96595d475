// SPDX-License-Identifier: MIT OR Apache-2.0
//! A real-time-safe transform buffer: the equivalent of ROS 2's tf2 `BufferCore`, with bounded memory and wait-free
//! lookups.
//!
//! One [`Writer`] sets rigid transforms between named frames; any number of threads look them up in a [`Buffer`] at the
//! same time, for a given time or for the latest common one. All memory is allocated when the buffer is created. There is
//! no lock: a reader never delays the writer, and a writer that is preempted at any point never delays a reader.
//!
//! ```
//! use tautline_tf::{Buffer, Kind, Limits, LookupError, Time, Transform, TransformStamped};
//!
//! let (mut writer, buffer) = Buffer::new(Limits::default())?;
//! let up = Transform::new([0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]);
//! writer.set(
//!     &TransformStamped { parent: "base_link", child: "laser", stamp_ns: 0, transform: up },
//!     Kind::Static,
//! )?;
//! for (stamp_ns, x) in [(1_000, 1.0), (2_000, 2.0)] {
//!     let moved = Transform::new([x, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]);
//!     writer.set(
//!         &TransformStamped { parent: "odom", child: "base_link", stamp_ns, transform: moved },
//!         Kind::Dynamic,
//!     )?;
//! }
//!
//! let laser = buffer.lookup("odom", "laser", Time::At(1_500))?;
//! assert_eq!(laser.transform.point([0.0, 0.0, 0.0]), [1.5, 0.0, 0.3]);
//! assert_eq!(buffer.lookup("odom", "laser", Time::Latest)?.stamp_ns, Some(2_000));
//! let error = buffer.lookup("odom", "laser", Time::At(3_000)).unwrap_err();
//! assert!(matches!(error, LookupError::Extrapolation { newest_ns: 2_000, .. }));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # As in tf2
//! - The direction of a transform, the checks of [`Writer::set`], interpolation, the latest common time, lookups through a
//!   fixed frame, the kinds of errors, a frame that gets a new parent or another [`Kind`].
//! - A part of the tree above the first common frame does not matter, even if it has no transform for the
//!   time.
//!
//! # What differs
//! - Each frame keeps a fixed number of samples ([`Limits::samples`]) in addition to the limit [`Limits::cache_time`]. The
//!   sample that was set first is removed first, together with all older samples. So a late sample replaces one that was set in
//!   time.
//! - Samples older than the cache time are no longer found as soon as the newest sample is set; tf2 removes them only at
//!   the next sample.
//! - A second sample with the same stamp is refused ([`SetError::Repeated`]), even if it is equal.
//! - Rotations are normalised when they are set. Infinite numbers are refused in the same way as NaN.
//! - A leading slash of a name is also removed in lookups, where tf2 refuses it.
//! - Names have at most [`FrameName::MAX_BYTES`] bytes, paths at most [`MAX_DEPTH`] transforms to the root (tf2: 1000). A cycle
//!   is a separate error.
//! - A cleared frame is treated like a frame that never had a parent: [`LookupError::Connectivity`].
//! - At [`Time::Latest`], a transform that consists only of static ones has no stamp, where tf2 returns zero.
//! - Names of broadcasters are not kept: [`Writer::set`] returns to its caller why a transform was refused.
//!
//! # Design
//! - A frame's samples lie in a ring in the order in which they were set, and are linked by their stamps (`ring.rs`). A
//!   lookup is a binary search in the ring, and follows links only past late samples.
//! - A late sample moves no other sample: it is written, then linked. So no reader must restart because of it.
//! - A sample is a sequence lock of atomics (`slot.rs`). A reader whose sample was overwritten does not retry: it then
//!   knows that the sample is older than everything in the buffer.
//! - Calls of [`Writer::clear`] are counted, and lookups that were interrupted by one retry, at most three
//!   times.
#![forbid(unsafe_code)]

mod buffer;
mod counters;
mod error;
mod limits;
mod names;
mod ring;
mod slot;
mod sync;
mod transform;
mod tree;
mod wait;
mod waiters;
mod writer;

#[cfg(all(test, taut_loom))]
mod loom_tests;

pub use buffer::{Buffer, Frame, FrameInfo, Stamped, Time};
pub use counters::BufferCounters;
pub use error::{LookupError, NamedFrame, SetError, WaitError};
pub use limits::{Limits, LimitsError};
pub use names::{FrameId, FrameName};
pub use slot::Kind;
pub use transform::Transform;
pub use tree::MAX_DEPTH;
pub use wait::WaitFor;
pub use writer::{TransformStamped, Writer};
