// SPDX-License-Identifier: MIT OR Apache-2.0
//! Response-time analysis for fixed-priority systems.
//!
//! Given every task of one core with its period, worst-case execution time (wcet) and priority, this crate bounds the
//! time from a task's release to the end of its callback, before anything runs. It knows nothing of the runtime:
//! plain data in, plain data out, exact integer nanoseconds throughout. Overflow is an error, never a wrap.
//!
//! | to | use |
//! |---|---|
//! | describe a core | [`Task`], [`Release`], [`Overheads`], [`Throttling`] |
//! | bound its response times | [`response_times`], [`response_times_with_overheads`], [`response_time_per_task`] |
//! | size queues | [`Response::queue_capacity`], [`queue_capacity`] |
//! | describe a thread under SCHED_DEADLINE | [`Reservation`], [`Task::reserved`] |
//! | account for locks | [`CriticalSection`], [`blocking`](blocking()) |
//! | choose priorities | [`assign`]: rate-monotonic, deadline-monotonic, Audsley's search |
//! | decide at a glance | [`utilisation`], [`liu_layland_bound`], [`hyperbolic_test`] |
//! | bound chains over cores and hosts | [`system`] |
//! | see how much may grow | [`sensitivity`] |
//! | see what happens | [`timeline`] |
//! | explain a run in which the host took the core | [`taken`] |
//! | read all of it from `system.toml` | [`mod@file`] |
//! | admit new load beside the load that runs | [`file::admission`] |
//!
//! # Model
//! Each core has fixed priorities and preempts: SCHED_FIFO threads pinned to it. Tasks do not suspend themselves while
//! they run. Deadlines may lie past the period; a task is analysed over its whole busy window.
//!
//! | symbol | is | field |
//! |---|---|---|
//! | T | period | [`Task::period_ns`] |
//! | C | worst-case execution time | [`Task::wcet_ns`] |
//! | D | deadline, relative to the release | [`Task::deadline_ns`] |
//! | J | release jitter | [`Task::jitter_ns`] |
//! | B | blocking by lower priorities | [`Task::blocking_ns`], [`Task::non_preemptive_ns`] |
//! | n(w) | most releases in a window w | [`Release::most_within`]: ceil((w + J) / T) for a period |
//!
//! Job q (0, 1, ...) of task i ends w(q) after the start of the longest busy window of its level, and
//!
//! ```text
//! w(q) = (q+1) C_i + B_i + sum over j of n_j(w(q)) C_j               j: same or higher priority, not i
//! R_i  = max over q of w(q) - q T_i + J_i                            until w(q) <= (q+1) T_i - J_i
//! ```
//!
//! which for R <= T is the recurrence of Joseph & Pandya (1986) and Audsley et al. (1993), and otherwise that of
//! Lehoczky (1990) and Tindell (1994). A task that nothing preempts once it runs starts s(q) after the start of the
//! window and ends C later, with n_j(s(q) + 1) releases of the others before it (Davis et al. 2007). In a thread
//! shared by several tasks in the order of arrival, a job that arrives at A ends at the fixed point of
//! F = B + sum over the thread of n_k(A + 1) C_k + sum over higher j of n_j(F) C_j, and R is the largest F - A
//! (Bedarkar et al. 2022); in any other order R is at most the busy window, which lower ranks of a thread that runs the highest
//! first enter with one job (George et al. 1996, for threads). A busy window begins with nothing left to do. So a task that others of its
//! core trigger, one after the other at its priority or above, is released in it as often as the first of these, and ends in it.
//!
//! With overheads, C of every callback grows by two context switches, and each message of *every* topic costs its
//! overhead at the highest priority, since the sampler serves the topics of lower priority too; so do timer ticks, and
//! the pauses of real-time throttling where they can happen.
//!
//! A thread that has the priority of each job while it runs that, and a ceiling otherwise ([`Task::lowered_to`]), takes from a task above a job
//! only what it uses at the ceiling to take the job; what waits in it behind that job counts with more jitter. Its own jobs wait for all above
//! its lowest priority.
//!
//! A task under SCHED_DEADLINE is above all priorities; for the others it is a task of its runtime and period that is released
//! with a jitter of one period, whatever it does ([`Reservation`]). Its own jobs find their runtime, or wait for the gap that its runtime
//! leaves of each period, as if that were work above it.
//!
//! A result without a bound says why: which level, which utilisation, which cause.
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

pub mod assign;
mod blocking;
mod error;
pub mod file;
mod level;
mod queue;
mod release;
mod response;
pub mod sensitivity;
pub mod system;
pub mod taken;
mod task;
pub mod timeline;
mod utilisation;
mod validate;

pub use blocking::{CriticalSection, LockProtocol, blocking};
pub use error::AnalysisError;
pub use queue::queue_capacity;
pub use release::{Distances, Release};
pub use response::{Response, response_time_per_task, response_times, response_times_with_overheads};
pub use task::{Group, Hold, Order, Overheads, Rank, Reservation, Task, Throttling};
pub use utilisation::{hyperbolic_test, liu_layland_bound, utilisation};
