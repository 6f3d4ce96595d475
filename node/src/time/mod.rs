// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clocks and simulated time.

mod clock;
mod source;
mod timer;

pub use clock::{Clock, ClockType};
pub use source::{ClockChange, ClockJump, JumpCallback, JumpThreshold, TimeSource};

pub(crate) use timer::RosTimer;
