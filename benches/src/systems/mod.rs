// SPDX-License-Identifier: MIT OR Apache-2.0
//! The systems that a bench runs itself, in processes of its own program: one for each end.

mod futex;
pub mod iceoryx;
mod service;
pub mod tautline;

use std::time::Duration;

use tautline_exchange::{Job, Result};

/// Runs one process of a system.
pub fn run(system: &str, job: &Job) -> Result<()> {
    match (system, job.way.mode.as_str()) {
        ("floor", "memcpy") => futex::copy(job),
        ("floor", "ring") => futex::flow(job),
        ("floor", _) => futex::run(job),
        ("iceoryx2", _) => iceoryx::run(job),
        ("tautline", "topics" | "service" | "service-owned") => service::run(job),
        ("tautline", _) => tautline::run(job),
        _ => Err(format!("this program does not run {system}").into()),
    }
}

/// How often it is looked whether the end has come.
const LOOK: Duration = Duration::from_millis(50);
