// SPDX-License-Identifier: MIT OR Apache-2.0
//! The sampler: created once per participant, run by one thread.

use crate::events::Events;
use crate::timers::TimerQueue;
use std::time::Duration;
use tautline_rt::{RtError, ThreadBuilder};
use tautline_transport::{Participant, SamplerSeat, TransportError};

/// How a sampler waits when nothing is pending.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Wait {
    /// Sleeps at once.
    #[default]
    Block,
    /// Spins for this time before it sleeps. While it spins, no thread of lower priority runs on its core.
    Adaptive(Duration),
}

/// When a sampler sleeps: see [`Sampler::spin_told`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sleep {
    /// The sampler is about to sleep.
    Begins,
    /// It has slept, unless something was pending first.
    Ends {
        /// The latest time at which a timer would end the sleep, in `CLOCK_MONOTONIC` ns; `None` if no timer
        /// is armed.
        due_ns: Option<u64>,
    },
}

/// Waits for samples, timers and guard conditions, and wakes the tasks that wait for them.
///
/// Runs on the thread that calls [`spin`](Sampler::spin) or [`spin_once`](Sampler::spin_once), or on its own thread
/// ([`start`](Sampler::start)). Give that thread the highest priority of the process.
pub struct Sampler {
    pub(crate) events: Events,
    pub(crate) timers: TimerQueue,
    pub(crate) wait: Wait,
    pub(crate) seat: SamplerSeat,
    pub(crate) trace: tautline_trace::SamplerObject,
    /// Whether it woke and has not traced the end of its service yet.
    pub(crate) awake: bool,
}

impl Sampler {
    /// The sampler of `participant`.
    ///
    /// # Real-time
    /// Setup only: allocates what it needs. Creating more timers than there was ever room for allocates the
    /// additional room.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if the participant already has a sampler, or if there is no memory for its slot.
    pub fn new(participant: &Participant) -> Result<Self, TransportError> {
        let seat = participant.doorbell().claim_sampler()?;
        let trace = tautline_trace::sampler_init(participant.trace_id(), "sampler");
        let (events, spares) = Events::new(participant)?;
        Ok(Sampler { events, timers: TimerQueue::new(spares), wait: Wait::Block, seat, trace, awake: false })
    }

    /// Sets how the sampler waits.
    #[must_use = "it returns the changed sampler"]
    pub fn with_wait(mut self, wait: Wait) -> Self {
        self.wait = wait;
        self
    }

    /// The part that other threads use, to create timers and guard conditions and to stop the sampler.
    pub fn events(&self) -> &Events {
        &self.events
    }

    /// Runs the sampler on its own thread, as described by `thread`: give it the highest priority.
    ///
    /// # Errors
    /// [`RtError`] if the thread cannot be created as described.
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

/// A sampler that runs on its own thread. Dropping it stops the sampler and joins the thread.
pub struct SamplerThread {
    events: Events,
    join: Option<tautline_rt::JoinHandle<Sampler>>,
}

impl SamplerThread {
    /// The part that other threads use, to create timers and guard conditions and to stop the sampler.
    pub fn events(&self) -> &Events {
        &self.events
    }

    /// Stops the sampler, joins its thread and returns the sampler.
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
