// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callback threads: one `LocalPool` and one priority each.
//!
//! - [`Executor::spawn_callback`] runs a future on its own thread: named, pinned, at its own `SCHED_FIFO` priority. So
//!   the kernel's scheduler decides between callbacks, and response-time analysis applies to them. The thread runs a
//!   [`futures::executor::LocalPool`], and sleeps when nothing is ready.
//! - A [`CallbackGroup`] is several callbacks on one thread that never overlap, served in order of release.
//! - [`CallbackOptions::direct_wake`] lets publishers wake the thread, through a [`Parker`] of the transport.
//! - [`CallbackOptions::busy_poll`] avoids the wake-up at the cost of a core: the thread polls and never
//!   parks.
//! - Each callback has [`CallbackStats`]: releases, completions, overruns, missed deadlines, execution and response times.
//!   Streams record them through [`job`]; the callback needs no code for this. With a [`StatisticsFile`] other
//!   processes can read them.
//! - [`Executor::account_core_time`] adds the time that was taken from each callback's core, so that a late job can be
//!   explained.
//! - [`CallbackOptions::budget`] and its handlers report when a job violates an assumption of the analysis.
//! - [`assign`] turns periods or deadlines into priorities.
//!
//! All memory is claimed before a thread becomes real-time. The code that runs after that is in `hot.rs`, and
//! allocates nothing.
//!
//! ```
//! use futures::{StreamExt, stream};
//! use tautline_executor::{CallbackOptions, Executor, Realtime};
//!
//! let executor = Executor::new(Realtime::Off); // Realtime::Required on a robot
//! let odometry = stream::iter([1.0, 2.0]);
//! let options = CallbackOptions::fifo(20).name("/odom");
//! let callback = executor.spawn_callback(options, odometry.for_each(|speed| async move { assert!(speed > 0.0) }))?;
//! callback.join()?;
//! executor.shutdown()?;
//! # Ok::<(), tautline_executor::ExecutorError>(())
//! ```
#![forbid(unsafe_code)]

mod account;
mod callback;
mod error;
mod executor;
pub mod foreign;
mod group;
mod hot;
mod options;
mod registry;
mod settings;
mod sleep;
mod stats;
mod sync;

pub mod assign;
pub mod job;

pub use account::{SamplerAccount, SamplerStatistics};
pub use callback::CallbackHandle;
pub use error::{ExecutorError, Panic};
pub use executor::Executor;
pub use foreign::{ForeignCallback, ForeignExecutor};
pub use group::{CallbackGroup, MemberOptions};
pub use hot::{Parker, busy_polling, parker, parks_on, stop_requested};
pub use options::{CallbackOptions, DeadlineMiss, Handler, Overrun, OverrunPolicy, Watch};
pub use registry::ThreadRegistration;
pub use settings::CallbackSettings;
pub use stats::{
    Admitted, Bucket, CallbackSnapshot, CallbackStats, ExecutorSnapshot, ForeignStatistics, Histogram,
    HistogramSnapshot, Moment, MomentKind, Order, Orders, ProcessInfo, ProcessSnapshot, SizeClass,
    StatisticsFile,
};
pub use tautline_rt::{CoreSet, Policy, Realtime};
