// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::sync::{Mutex, PoisonError, Weak};
use std::time::Duration;
use tautline::builtin_interfaces::msg::Time;
use tautline::{ClockType, Error, Result};

/// A clock with r2r's API; it wraps a [`tautline::Clock`]. A clone shows the same time.
///
/// ```
/// use tautline_r2r::{Clock, ClockType};
///
/// let mut clock = Clock::create(ClockType::SystemTime)?;
/// let now = clock.get_now()?;
/// let stamp = Clock::to_builtin_time(&now); // for the header of a message
/// # assert!(stamp.sec > 0);
/// # Ok::<(), tautline_r2r::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Clock(tautline::Clock);

impl Clock {
    /// A clock of this type. A clock of type [`ClockType::RosTime`] shows the system's time until it is
    /// [attached](TimeSource::attach_ros_clock) to a node's time source: see [`Node::get_ros_clock`](crate::Node::get_ros_clock).
    ///
    /// # Errors
    /// None.
    pub fn create(ct: ClockType) -> Result<Clock> {
        Ok(Clock(tautline::Clock::new(ct)))
    }

    /// The time.
    ///
    /// # Errors
    /// None.
    pub fn get_now(&mut self) -> Result<Duration> {
        Ok(self.0.now())
    }

    /// Its type.
    pub fn get_clock_type(&self) -> ClockType {
        self.0.clock_type()
    }

    /// As [`tautline::Clock::to_builtin_time`].
    pub fn to_builtin_time(d: &Duration) -> Time {
        tautline::Clock::to_builtin_time(d)
    }
}

/// A time source with r2r's API; it wraps a [`tautline::TimeSource`].
#[derive(Clone, Debug)]
pub struct TimeSource(tautline::TimeSource);

impl TimeSource {
    /// Makes `clock`, of type [`ClockType::RosTime`], show the time of the node's ROS clock from now on.
    ///
    /// # Errors
    /// [`Error::ClockTypeNotRosTime`].
    pub fn attach_ros_clock(&self, clock: Weak<Mutex<Clock>>) -> Result<()> {
        let Some(clock) = clock.upgrade() else { return Ok(()) };
        let mut clock = clock.lock().unwrap_or_else(PoisonError::into_inner);
        if clock.get_clock_type() != ClockType::RosTime {
            return Err(Error::ClockTypeNotRosTime);
        }
        *clock = self.0.clock().into();
        Ok(())
    }
}

/// A timer with r2r's API; it wraps a [`tautline::Timer`].
#[derive(Debug)]
#[must_use = "nothing happens unless it is awaited; dropping it ends it"]
pub struct Timer(
    tautline::Timer,
    /// The last release, in nanoseconds.
    Option<u64>,
);

impl Timer {
    /// Waits for the next release and returns the time since the previous one: one period, or several if releases were
    /// missed. The first time it returns one period.
    ///
    /// # Errors
    /// [`Error::NodeEnded`]: the node was dropped.
    pub async fn tick(&mut self) -> Result<Duration> {
        let release_ns = self.0.next().await.ok_or(Error::NodeEnded)?.release_ns;
        let last = self.1.replace(release_ns);
        Ok(match last {
            Some(last_ns) => Duration::from_nanos(release_ns.saturating_sub(last_ns)),
            None => self.0.period(),
        })
    }
}

beneath!(Clock);
beneath!(TimeSource);
beneath!(Timer, None);
