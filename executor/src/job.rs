// SPDX-License-Identifier: MIT OR Apache-2.0
//! Measurement of jobs from within a stream.
//!
//! A stream that yields an item calls [`begin`] with the item's release and keeps the [`Job`]. Its next `poll_next`
//! calls [`Job::finish`], because only then has the callback finished with the item. So `stream.for_each(..)` is
//! measured without changes:
//!
//! ```
//! use futures::{Stream, StreamExt, task::{Context, Poll}};
//! use std::pin::Pin;
//! use tautline_executor::{CallbackOptions, Executor, Realtime, job};
//!
//! struct Ticks { left: u32, job: Option<job::Job> }
//!
//! impl Stream for Ticks {
//!     type Item = u32;
//!     fn poll_next(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<u32>> {
//!         if let Some(job) = self.job.take() {
//!             job.finish();
//!         }
//!         let Some(left) = self.left.checked_sub(1) else { return Poll::Ready(None) };
//!         self.left = left;
//!         self.job = Some(job::begin(0)); // the release, in ns of CLOCK_MONOTONIC
//!         Poll::Ready(Some(left))
//!     }
//! }
//!
//! let executor = Executor::new(Realtime::Off);
//! let ticks = Ticks { left: 3, job: None };
//! let callback = executor.spawn_callback(CallbackOptions::other(), ticks.for_each(|_| async {}))?;
//! let stats = callback.stats().clone();
//! callback.join()?;
//! assert_eq!((stats.releases(), stats.completions()), (3, 3));
//! # Ok::<(), tautline_executor::ExecutorError>(())
//! ```
//!
//! Outside of a callback thread both calls do nothing. In a [`CallbackGroup`](crate::CallbackGroup) they do nothing
//! either: the group measures its members itself, because it takes an item before it runs the callback for it. If two
//! streams of one callback overlap, both jobs count, and each is charged the CPU time since the end of the previous
//! one.

pub use crate::hot::{Job, begin, begin_for, note_queue, set_input_size};
pub use crate::stats::QueueState;
