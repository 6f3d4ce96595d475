// SPDX-License-Identifier: MIT OR Apache-2.0
//! A real-time-safe transform buffer: what tf2's `BufferCore` is for ROS 2, with bounded memory and wait-free lookups.
//!
//! One [`Writer`] sets rigid transforms between named frames; any number of threads look them up in a [`Buffer`], at a time
//! or at the latest common one, while it does. All memory is allocated when the buffer is made. Nobody takes a lock: a
//! reader never holds up the writer, and a writer that is preempted anywhere never holds up a reader.
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
//! - Which transform is meant, the checks of [`Writer::set`], interpolation, the latest common time, lookups through a fixed
//!   frame, errors by kind, a frame that gets a new parent or another [`Kind`].
//! - What cannot be reached at a time above the first common frame does not matter.
//!
//! # What differs
//! - Each frame keeps a fixed number of samples ([`Limits::samples`]) beside [`Limits::cache_time`]. The one that was set first
//!   goes first, and what is older goes with it; so a sample that comes late takes the place of one that was set in time.
//! - Samples older than the cache time are not found from the moment on at which the newest is set; tf2 removes them at the
//!   next one.
//! - A second sample with the same stamp is refused ([`SetError::Repeated`]), even if it is equal.
//! - Rotations are normalised when they are set. What is infinite is refused as what is not a number.
//! - A slash in front of a name is taken off in lookups, too, where tf2 refuses it.
//! - Names have at most [`FrameName::MAX_BYTES`] bytes, paths at most [`MAX_DEPTH`] transforms to the root (tf2: 1000). A cycle
//!   is an error of its own.
//! - A frame that was cleared is as one that never had a parent: [`LookupError::Connectivity`].
//! - A transform of static ones alone has no stamp at [`Time::Latest`], where tf2 says zero.
//! - Names of broadcasters are not kept: [`Writer::set`] tells its caller what was refused.
//!
//! # Design
//! - A frame's samples lie in a ring by the order in which they were set, and are linked by their stamps (`ring.rs`). A
//!   lookup is a binary search in the ring, and follows links only past samples that came late.
//! - Nothing moves when a sample comes late: it is written, then linked. So no reader has to start again because of it.
//! - A sample is a sequence lock of atomics (`slot.rs`). A reader whose sample was overwritten does not try again either:
//!   it has learnt that it is older than what the buffer holds.
//! - [`Writer::clear`] is counted, and lookups that it came between look again, three times at most.
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
mod writer;

#[cfg(all(test, taut_loom))]
mod loom_tests;

pub use buffer::{Buffer, Frame, FrameInfo, Stamped, Time};
pub use counters::BufferCounters;
pub use error::{LookupError, NamedFrame, SetError, WaitError};
pub use limits::{Limits, LimitsError};
pub use names::{FrameId, FrameName};
pub use ring::Kind;
pub use transform::Transform;
pub use tree::MAX_DEPTH;
pub use wait::WaitFor;
pub use writer::{TransformStamped, Writer};
