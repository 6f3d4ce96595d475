// SPDX-License-Identifier: MIT OR Apache-2.0
//! The sampler: made once per participant, run by one thread.

use crate::events::Events;
use crate::hot::TimerQueue;
use std::time::Duration;
use tautline_rt::{RtError, ThreadBuilder};
use tautline_transport::{Participant, SamplerSeat, TransportError};

/// How a sampler waits when nothing is pending.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Wait {
    /// Sleeps at once.
    #[default]
    Block,
    /// Spins for this long before it sleeps. While it spins nothing of lower priority runs on its core.
    Adaptive(Duration),
}

/// When a sampler sleeps: see [`Sampler::spin_told`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sleep {
    /// The sampler is about to sleep.
    Begins,
    /// It has slept, if nothing came first.
    Ends {
        /// When a timer was to end it at the latest, in ns of `CLOCK_MONOTONIC`; `None` if no timer is armed.
        due_ns: Option<u64>,
    },
}

/// Waits for samples, timers and guard conditions, and wakes the tasks that wait for them.
///
/// Runs on the thread that calls [`spin`](Sampler::spin) or [`spin_once`](Sampler::spin_once), or on one of its own
/// ([`start`](Sampler::start)). Give that thread the highest priority of the process.
pub struct Sampler {
    pub(crate) events: Events,
    pub(crate) timers: TimerQueue,
    pub(crate) wait: Wait,
    pub(crate) seat: SamplerSeat,
    pub(crate) trace: tautline_trace::SamplerObject,
    /// It woke and has not told that it served.
    pub(crate) awake: bool,
}

impl Sampler {
    /// The sampler of `participant`.
    ///
    /// # Real-time
    /// Setup only: allocates what it needs; who makes more timers than there was ever room for brings the room.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if the participant has one already; the same of another kind if there is no memory for
    /// its slot.
    pub fn new(participant: &Participant) -> Result<Self, TransportError> {
        let seat = participant.doorbell().claim_sampler()?;
        let trace = tautline_trace::sampler_init(participant.trace_id(), "sampler");
        let (events, spares) = Events::new(participant)?;
        Ok(Sampler { events, timers: TimerQueue::new(spares), wait: Wait::Block, seat, trace, awake: false })
    }

    /// The same, waiting another way.
    #[must_use = "it returns the changed sampler"]
    pub fn with_wait(mut self, wait: Wait) -> Self {
        self.wait = wait;
        self
    }

    /// What other threads hold to make timers and guard conditions and to stop the sampler.
    pub fn events(&self) -> &Events {
        &self.events
    }

    /// Runs the sampler on a thread of its own, which `thread` describes: give it the highest priority.
    ///
    /// # Errors
    /// [`RtError`] if the thread cannot be had as described.
    pub fn start(mut self, thread: ThreadBuilder) -> Result<SamplerThread, RtError> {
        let events = self.events.clone();
        let join = thread.spawn(move || {
            move || {
                self.spin();
                self
            }
        })?;
        Ok(SamplerThread { events, join: Some(join) })
    }
}

/// A sampler that runs on a thread of its own. Dropping it stops the sampler and joins the thread.
pub struct SamplerThread {
    events: Events,
    join: Option<tautline_rt::JoinHandle<Sampler>>,
}

impl SamplerThread {
    /// What other threads hold to make timers and guard conditions and to stop the sampler.
    pub fn events(&self) -> &Events {
        &self.events
    }

    /// Stops the sampler, joins its thread and gives the sampler back.
    ///
    /// # Errors
    /// [`RtError`] if the thread panicked.
    pub fn stop(mut self) -> Result<Option<Sampler>, RtError> {
        self.events.stop();
        self.join.take().map(tautline_rt::JoinHandle::join).transpose()
    }
}

impl Drop for SamplerThread {
    fn drop(&mut self) {
        self.events.stop();
        if let Some(join) = self.join.take() {
            let _ = join.join();
        }
    }
}
