// SPDX-License-Identifier: MIT OR Apache-2.0
//! Response-time analysis for fixed-priority systems.
//!
//! Given every task of one core with its period, worst-case execution time (wcet) and priority, this crate bounds the
//! time from a task's release to the end of its callback, before anything runs. It knows nothing of the runtime:
//! plain data in, plain data out, exact integer nanoseconds throughout. Overflow is an error, never a wrap.
//!
//! - [`Task`] and [`Overheads`] describe the core; [`response_times`] and [`response_times_with_overheads`] bound it.
//! - [`response_time_per_task`] does the same without letting one overloaded priority hide the bounds above it.
//! - [`queue_capacity`] and [`Response::queue_capacity`] say how deep a subscription's queue must be to lose nothing.
//!
//! # Model
//! One core, fixed priorities, fully preemptive: SCHED_FIFO threads pinned to it. Tasks are sporadic (a period is the
//! shortest time between two releases) and do not suspend themselves while they run. Deadlines may lie past the
//! period; a task whose response time exceeds its period is analysed over its whole busy window.
//!
//! | symbol | is | field |
//! |---|---|---|
//! | T | period | [`Task::period_ns`] |
//! | C | worst-case execution time | [`Task::wcet_ns`] |
//! | D | deadline, relative to the release | [`Task::deadline_ns`] |
//! | J | release jitter | [`Task::jitter_ns`] |
//! | B | blocking by lower priorities | [`Task::blocking_ns`] |
//!
//! Job q (0, 1, ...) of task i ends w(q) after the start of the longest busy window of its level, and
//!
//! ```text
//! w(q) = (q+1) C_i + B_i + sum over j of ceil((w(q) + J_j) / T_j) C_j      j: same or higher priority, not i
//! R_i  = max over q of w(q) - q T_i + J_i                                  until w(q) <= (q+1) T_i - J_i
//! ```
//!
//! which for R <= T is the recurrence of Joseph & Pandya (1986) and Audsley et al. (1993), and otherwise that of
//! Lehoczky (1990) and Tindell (1994). With overheads, C of every callback grows by two context switches, and each
//! message of *every* topic costs its overhead at the highest priority, since the sampler serves the topics of lower
//! priority too.
//!
//! # Example
//! Five callbacks at rate-monotonic priorities; the work of the sampler, 60 µs for each message, pushes the slowest
//! one across a release of the fastest:
//! ```
//! use std::time::Duration;
//! use tautline_analysis::{Overheads, Task, response_times, response_times_with_overheads, utilisation};
//!
//! let ms = Duration::from_millis;
//! let tasks = [
//!     Task::new("topic1", ms(10), ms(2), 20),
//!     Task::new("topic2", ms(20), ms(4), 19),
//!     Task::new("topic3", ms(50), ms(5), 18),
//!     Task::new("topic4", ms(100), ms(15), 17),
//!     Task::new("topic5", ms(200), ms(50), 16),
//! ];
//! assert!((utilisation(&tasks) - 0.9).abs() < 1e-9);
//!
//! let bounds: Vec<_> = response_times(&tasks)?.iter().map(|r| r.response().as_millis()).collect();
//! assert_eq!(bounds, [2, 6, 13, 36, 170]);
//!
//! let overheads = Overheads { per_message_ns: 60_000, ..Overheads::NONE };
//! let slowest = &response_times_with_overheads(&tasks, &overheads)?[4];
//! assert_eq!(slowest.response_ns, 174_040_000);
//! assert!(slowest.met);
//! assert_eq!(slowest.queue_capacity()?, 1);
//! # Ok::<(), tautline_analysis::AnalysisError>(())
//! ```
#![forbid(unsafe_code)]

mod error;
mod queue;
mod response;
mod task;

pub use error::AnalysisError;
pub use queue::queue_capacity;
pub use response::{Response, response_time_per_task, response_times, response_times_with_overheads};
pub use task::{Overheads, Task, utilisation};
