// SPDX-License-Identifier: MIT OR Apache-2.0
//! The statistics of callbacks, readable while they run, by this and other processes.

mod block;
mod callback;
mod file;
mod histogram;
mod hot;
mod inputs;
mod moments;

pub use block::CallbackSnapshot;
pub(crate) use block::kind;
pub(crate) use callback::Job;
pub use callback::{CallbackStats, QueueState};
pub use file::{
    Admitted, ExecutorSnapshot, ForeignStatistics, Order, Orders, ProcessInfo, ProcessSnapshot,
    StatisticsFile,
};
pub use histogram::{Bucket, Histogram, HistogramSnapshot};
pub use inputs::SizeClass;
pub use moments::{Moment, MomentKind};
