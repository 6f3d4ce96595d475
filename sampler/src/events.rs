// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a sampler serves in addition to samples: timers and guard conditions, created from any thread.

use crate::timers::{SpareQueues, TimerWords, Timers};
use std::borrow::Borrow;
use std::future::poll_fn;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::task::{Context, Poll};
use tautline_transport::{Activity, Doorbell, Participant, Slot, TransportError};

/// The part of a sampler that other threads use, to create timers and guard conditions, and to stop the sampler.
#[derive(Clone)]
pub struct Events {
    pub(crate) state: Arc<SamplerState>,
}

pub(crate) struct SamplerState {
    pub(crate) doorbell: Arc<Doorbell>,
    pub(crate) timers: Timers,
    stop: AtomicBool,
    stop_slot: Slot,
}

impl Events {
    /// Creates the part that other threads use, and the spare queues for the sampler.
    pub(crate) fn new(participant: &Participant) -> Result<(Self, SpareQueues), TransportError> {
        let (timers, spares) = Timers::new();
        let state = SamplerState {
            doorbell: participant.doorbell().clone(),
            timers,
            stop: AtomicBool::new(false),
            stop_slot: participant.claim_slot()?,
        };
        Ok((Events { state: Arc::new(state) }, spares))
    }

    pub(crate) fn timer_slot<S: From<Slot> + Borrow<Slot>>(&self) -> Result<TimerSlot<S>, TransportError> {
        let slot = self.state.doorbell.claim()?;
        self.state.timers.cover(slot.index());
        Ok(TimerSlot { state: self.state.clone(), slot: slot.into() })
    }

    /// A condition that any thread can trigger and one task waits for.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if there is no memory for its slot.
    pub fn guard_condition(&self) -> Result<GuardCondition, TransportError> {
        let slot = Arc::new(self.state.doorbell.claim()?);
        let condition = Condition { slot, triggered: AtomicU64::new(0) };
        Ok(GuardCondition { condition: Arc::new(condition), seen: 0 })
    }

    /// Makes `spin` return, now or when it is next called.
    ///
    /// # Real-time
    /// Wait-free; at most one futex wake.
    pub fn stop(&self) {
        self.state.stop.store(true, Ordering::Release);
        self.state.stop_slot.ring();
    }

    /// Whether the sampler was stopped.
    pub fn is_stopped(&self) -> bool {
        self.state.stop.load(Ordering::Acquire)
    }
}

/// A slot at which the sampler releases a timer, watchdog or alarm at the armed times, until this is dropped.
pub(crate) struct TimerSlot<S: Borrow<Slot>> {
    state: Arc<SamplerState>,
    pub(crate) slot: S,
}

/// # Real-time
/// All wait-free; no allocation; at most one futex wake.
impl<S: Borrow<Slot>> TimerSlot<S> {
    pub(crate) fn words(&self) -> &TimerWords {
        self.state.timers.at(self.slot.borrow().index())
    }

    /// See [`TimerWords::arm`].
    pub(crate) fn arm(&self, first_release_ns: u64, period_ns: u64, activity: Option<Activity>) -> u64 {
        let number = self.words().arm(first_release_ns, period_ns, activity);
        self.slot.borrow().ring();
        number
    }

    pub(crate) fn disarm(&self) {
        self.words().disarm();
        self.slot.borrow().ring();
    }

    /// Makes releases wake the task of `context` from now on.
    pub(crate) fn register(&self, context: &Context<'_>) {
        self.slot.borrow().waker().register(context.waker());
    }
}

impl<S: Borrow<Slot>> Drop for TimerSlot<S> {
    fn drop(&mut self) {
        self.disarm();
    }
}

struct Condition {
    slot: Arc<Slot>,
    triggered: AtomicU64,
}

/// Wakes one task when [triggered](GuardCondition::trigger), from any thread. A clone is the same condition, but
/// remembers separately which triggers it has seen.
#[derive(Clone)]
pub struct GuardCondition {
    condition: Arc<Condition>,
    seen: u64,
}

/// The condition's slot.
impl AsRef<Arc<Slot>> for GuardCondition {
    fn as_ref(&self) -> &Arc<Slot> {
        &self.condition.slot
    }
}

impl GuardCondition {
    /// Triggers the condition. All triggers before the task checks count as one.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake.
    pub fn trigger(&self) {
        // Release: pairs with the Acquire in `poll_triggered`.
        self.condition.triggered.fetch_add(1, Ordering::Release);
        self.condition.slot.ring();
    }

    /// Waits until the condition has been triggered since the last wait, or since it was created. Only one task may
    /// wait at a time: a second one replaces the first.
    ///
    /// # Real-time
    /// Each poll wait-free; no allocation.
    pub async fn triggered(&mut self) {
        poll_fn(|context| self.poll_triggered(context)).await;
    }

    /// The poll function of [`triggered`](Self::triggered).
    pub fn poll_triggered(&mut self, context: &mut Context<'_>) -> Poll<()> {
        self.condition.slot.waker().register(context.waker());
        let triggered = self.condition.triggered.load(Ordering::Acquire);
        if triggered == self.seen {
            return Poll::Pending;
        }
        self.seen = triggered;
        Poll::Ready(())
    }
}
