// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node's clock, and timers on it.

use super::{Node, check_period};
#[allow(unused_imports, reason = "for the documentation")]
use crate::error::Error;
use crate::error::Result;
use crate::time::{Clock, RosTimer, TimeSource};
use crate::timer::Timer;
use std::time::Duration;

impl Node {
    /// The node's ROS clock: the system's time or, with `use_sim_time`, that of `/clock`.
    pub fn clock(&self) -> Clock {
        Clock::of_source(self.time_source.clone())
    }

    /// The time source of the node's ROS clock.
    pub fn time_source(&self) -> TimeSource {
        self.time_source.clone()
    }

    /// Creates a timer on the node's ROS clock, whose first release is one period from now. On simulated time it pauses, runs
    /// and jumps with `/clock`: a jump forward causes one release, and the skipped releases are counted as missed; a jump
    /// back starts a new period. While the clock shows the system's time, releases are on the monotonic clock, as with
    /// [`create_wall_timer`](Self::create_wall_timer): setting the system's time does not affect them.
    ///
    /// # Errors
    /// [`Error::ZeroPeriod`]; [`Error::ShortPeriod`] below 1 µs; [`Error::Transport`] if there is no memory for its slot; [`Error::ClockUsers`].
    pub fn create_timer(&mut self, period: Duration) -> Result<Timer> {
        check_period(period)?;
        let _node = tautline_trace::in_node(self.trace.id());
        // Simulated time has 63 bits.
        let period_ns = i64::try_from(period.as_nanos()).unwrap_or(i64::MAX).unsigned_abs();
        let events = self.context.events().clone();
        let timer = RosTimer::new(&self.handle, self.time_source.waiter()?, events, period_ns)?;
        Ok(Timer::on_ros_clock(&self.handle, timer))
    }
}
