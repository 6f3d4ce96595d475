// SPDX-License-Identifier: MIT OR Apache-2.0
//! The system file's settings for callbacks that wait for several topics.

use crate::error::{Error, Result};
use std::time::Duration;
use tautline_analysis::file::CheckedJoin;
use tautline_join::{ApproximateEpsilonTime, ApproximateTime, ExactTime};
use tautline_system::{LoadedSystem, SystemError};
use tautline_transport::Limits;

pub(crate) fn join_of(system: &LoadedSystem, name: &str) -> Result<CallbackJoin> {
    let callback = system.find(name)?;
    let (name, path) = (name.to_owned(), system.path().to_owned());
    if !callback.entry.joins {
        return Err(Error::NoJoin { name, path });
    }
    let bounds = callback.join.as_ref().zip(callback.response_overhead_ns);
    let longest =
        |join: &CheckedJoin| join.inputs.iter().try_fold(0, |most: u64, (_, ns)| Some(most.max((*ns)?)));
    let bounds = bounds.and_then(|(join, response_ns)| Some((join, longest(join)?, response_ns)));
    let (join, wait_ns, response_ns) = bounds.ok_or(SystemError::NoCapacity { name, path })?;
    Ok(CallbackJoin {
        window: join.window_ns.map(Duration::from_nanos),
        queue_size: join.queue_size,
        latency: Duration::from_nanos(wait_ns.saturating_add(response_ns)),
    })
}

/// The settings of a callback that waits for several topics, from the system file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct CallbackJoin {
    /// The maximum distance between the stamps of a set: zero for equal stamps. `None`: it takes the newest message of each topic,
    /// whatever its stamp, when all have arrived, or at the rate of the fastest topic.
    pub window: Option<Duration>,
    /// The maximum number of queued messages of a topic: by the computation enough that no message is dropped which may
    /// be needed.
    pub queue_size: usize,
    /// The computed longest time from the arrival of a message that is in a set to the end of the callback's work on this set.
    pub latency: Duration,
}

impl CallbackJoin {
    /// For [`Synchronizer::new`](crate::join::Synchronizer::new): close stamps, within the window.
    pub fn approximate_time(&self) -> ApproximateTime {
        ApproximateTime::new(self.queue_size).max_interval(self.window.unwrap_or(Duration::MAX))
    }

    /// For [`Synchronizer::new`](crate::join::Synchronizer::new), with `policy = "approximate_epsilon_time"`: the first stamps within the
    /// window.
    pub fn approximate_epsilon_time(&self) -> ApproximateEpsilonTime {
        ApproximateEpsilonTime::new(self.queue_size, self.window.unwrap_or(Duration::MAX))
    }

    /// For [`Synchronizer::new`](crate::join::Synchronizer::new): equal stamps.
    pub fn exact_time(&self) -> ExactTime {
        ExactTime::new(self.queue_size)
    }

    /// The limits of a subscription of the join, for [`Node::set_topic_limits`](crate::Node::set_topic_limits): the queued
    /// messages, one that arrives, and one that the callback works on.
    pub fn limits(&self) -> Limits {
        Limits { held: self.queue_size.saturating_add(2).clamp(4, Limits::MAX_HELD), ..Limits::default() }
    }
}
