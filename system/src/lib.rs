// SPDX-License-Identifier: MIT OR Apache-2.0
//! The system file at run time, for nodes of Tautline and of ROS 2 alike.
//!
//! - [`LoadedSystem`] is a system file as one host sees it: the threads, budgets and queues that `taut check` computed.
//! - [`admit_system`] and [`admit_callbacks`] check new load against the load that runs in the domain.
//! - [`realtime_of_environment`] and its siblings read the variables that decide both.
#![forbid(unsafe_code)]

mod admission;
mod environment;
mod error;
mod loaded;
mod statistics;

pub use admission::{Admission, Gate, Running, admit_callbacks, admit_system, decide, is_one_file, label_of};
pub use environment::{
    CORE_TIME_PIECE, admission_of_environment, core_time_of_environment, environment,
    realtime_of_environment, switch_of_environment,
};
pub use error::SystemError;
pub use loaded::LoadedSystem;
pub use statistics::shared_statistics;
