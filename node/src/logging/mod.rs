// SPDX-License-Identifier: MIT OR Apache-2.0
//! Logging as ROS 2 does it: named loggers with levels, lines on the console and on `/rosout`.
//!
//! ```
//! tautline::logging::set_level(tautline::LogSeverity::Warn);
//! tautline::log_warn!("robot.arm", "joint {} is warm", 3);
//! tautline::logging::flush();
//! ```
//!
//! - [`log_info!`](crate::log_info) and the like take a [`Logger`], as of [`Node::logger`](crate::Node::logger), or a name.
//! - Levels are the process's and can be changed at any time: [`set_level`], [`Logger::set_level`],
//!   `--ros-args --log-level warn --log-level robot.arm:=debug`, or by other nodes and `taut log level`
//!   ([`Node::make_logger_handler`](crate::Node::make_logger_handler)).
//! - A thread with a real-time policy never waits: its line is formatted into 464 bytes (a longer line is truncated) and
//!   put into a ring of 64 lines; a low-priority thread, `log`, writes it within 20 ms. If the ring is full, lines are
//!   counted as lost, and a log line states their number. Other threads write their lines themselves.
//! - Lines of the nodes' loggers, and of loggers below them, are published on `/rosout`. The topic is created with the
//!   first line. A node's logger is used as long as it, a clone, or a logger below it exists. Lines of other names are
//!   only printed.
//! - `TracingLayer` (feature `tracing-layer`) logs the events of `tracing` macros in the same way: Tautline's own
//!   warnings, and those of other crates.

mod console;
#[cfg(feature = "tracing-layer")]
mod layer;
mod line;
mod logger;
mod macros;
mod output;
mod rings;
mod rosout;
#[cfg(feature = "rcl_interfaces")]
pub(crate) mod services;
mod severity;

#[cfg(feature = "tracing-layer")]
pub use layer::TracingLayer;
pub use logger::{LogTarget, Logger, Occasional};
pub use output::{flush, lost_lines};
pub use severity::LogSeverity;

#[doc(hidden)]
pub use logger::Site;

pub(crate) use output::{FlushOnDrop, start};
pub(crate) use rosout::Rosout;

use std::sync::atomic::Ordering;

/// Sets the minimum severity of lines of loggers without their own level.
pub fn set_level(level: LogSeverity) {
    severity::LEVELS.set_all(level);
}

/// Applies the settings of the command line: levels, of all loggers or of those with a name, and whether the console shows lines.
pub(crate) fn configure(levels: &[(Option<String>, LogSeverity)], console: Option<bool>) {
    for (logger, level) in levels {
        match logger {
            Some(logger) => severity::LEVELS.set(logger, *level),
            None => set_level(*level),
        }
    }
    if let Some(console) = console {
        output::TO_CONSOLE.store(console, Ordering::Relaxed);
    }
}
