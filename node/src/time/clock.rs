// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clocks, as in ROS 2.

use super::source::{ClockJump, JumpCallback, JumpThreshold, TimeSource};
use crate::context::Context;
use crate::error::{Error, Result};
use std::future::poll_fn;
use std::task::Poll;
use std::time::Duration;
use tautline_rt::clock::{monotonic_ns, nanoseconds, wall_ns};
use tautline_sampler::Alarm;

/// The type of a clock.
#[derive(Debug, Copy, Clone, PartialEq, Eq)]
pub enum ClockType {
    /// The system's time, or the time of `/clock` in nodes with `use_sim_time`.
    RosTime,
    /// The system's time since 1970; it may be set.
    SystemTime,
    /// The time since an arbitrary start; never set.
    SteadyTime,
}

/// A clock. A clone shows the same time.
///
/// ```
/// use tautline::{Clock, ClockType};
///
/// let clock = Clock::new(ClockType::SystemTime);
/// let stamp = Clock::to_builtin_time(&clock.now()); // for the header of a message
/// # assert!(stamp.sec > 0);
/// ```
#[derive(Clone)]
pub struct Clock {
    kind: ClockType,
    source: Option<TimeSource>,
}

impl Clock {
    /// A clock of this type. A clock of type [`ClockType::RosTime`] shows the system's time; for a node's ROS clock see
    /// [`Node::clock`](crate::Node::clock).
    pub fn new(kind: ClockType) -> Clock {
        Clock { kind, source: None }
    }

    pub(crate) fn of_source(source: TimeSource) -> Clock {
        Clock { kind: ClockType::RosTime, source: Some(source) }
    }

    /// The time.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. With simulated time: takes a lock while it reads new messages of
    /// `/clock`.
    pub fn now(&self) -> Duration {
        Duration::from_nanos(u64::try_from(self.now_ns()).unwrap_or_default())
    }

    /// The time in nanoseconds.
    ///
    /// # Real-time
    /// As [`now`](Self::now).
    pub fn now_ns(&self) -> i64 {
        let simulated = || self.source.as_ref().and_then(TimeSource::simulated_ns);
        match self.kind {
            ClockType::SteadyTime => monotonic_ns().cast_signed(),
            ClockType::SystemTime => wall_ns(),
            ClockType::RosTime => simulated().unwrap_or_else(wall_ns),
        }
    }

    /// Whether it shows the time of `/clock`.
    pub fn is_simulated(&self) -> bool {
        self.kind == ClockType::RosTime && self.source.as_ref().is_some_and(TimeSource::is_enabled)
    }

    /// Its type.
    pub fn clock_type(&self) -> ClockType {
        self.kind
    }

    /// Converts a time into its message; seconds that do not fit into 32 bits are truncated.
    pub fn to_builtin_time(d: &Duration) -> tautline_ros_msgs::builtin_interfaces::msg::Time {
        tautline_ros_msgs::builtin_interfaces::msg::Time {
            sec: d.as_secs() as i32,
            nanosec: d.subsec_nanos(),
        }
    }

    /// Waits until the clock shows `until`, also if the clock jumps there. The context's sampler wakes it.
    ///
    /// # Real-time
    /// The setup claims a slot of the context, and a subscription if the time is simulated; after that each poll is
    /// wait-free. A change of the system's clock is noticed within a second.
    ///
    /// # Errors
    /// [`Error::Transport`]: no slot is left, or `/clock` cannot be subscribed to.
    pub async fn sleep_until(&self, until: Duration, context: &Context) -> Result<()> {
        /// How long the system's clock is trusted not to be set.
        const LONGEST: Duration = Duration::from_secs(1);
        // Also woken when the clock's time source changes.
        let waiter = self.source.as_ref().map(TimeSource::waiter).transpose()?;
        // Rings once: a timer would keep ringing until a busy thread polls.
        let mut alarm = Alarm::new(context.events())?;
        loop {
            let left = until.saturating_sub(self.now());
            if left.is_zero() {
                return Ok(());
            }
            let simulated = self.is_simulated();
            let left = match self.kind {
                ClockType::SteadyTime => Some(left),
                _ if simulated => None,
                _ => Some(left.min(LONGEST)),
            };
            alarm.set(left.map(|left| monotonic_ns().saturating_add(nanoseconds(left))));
            poll_fn(|task| {
                if let Some(waiter) = &waiter {
                    waiter.register(task);
                }
                let is_due = alarm.poll(task).is_ready();
                if is_due || self.is_simulated() != simulated || self.now() >= until {
                    Poll::Ready(())
                } else {
                    Poll::Pending
                }
            })
            .await;
        }
    }

    /// Calls `callback` after the time of `/clock` has jumped by at least `threshold`, or after the clock's time source
    /// has changed, in the thread that reads the jump. For a node's clock with [`ClockType::RosTime`].
    ///
    /// # Errors
    /// [`Error::ClockTypeNotRosTime`]: other clocks do not jump.
    pub fn on_jump(
        &self,
        threshold: JumpThreshold,
        callback: impl Fn(ClockJump) + Send + Sync + 'static,
    ) -> Result<JumpCallback> {
        let source = self.source.as_ref().ok_or(Error::ClockTypeNotRosTime)?;
        Ok(source.on_jump(threshold, callback))
    }
}

impl TimeSource {
    /// A clock that shows the time of the node's ROS clock.
    pub fn clock(&self) -> Clock {
        Clock::of_source(self.clone())
    }
}

tautline_rt::debug_fields!(Clock, |this| kind = this.kind);
