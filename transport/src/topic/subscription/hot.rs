// SPDX-License-Identifier: MIT OR Apache-2.0
//! Taking samples.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::error::TakeError;
use crate::memory::header::{ENCAPSULATION, Gid, MessageInfo, NEVER, SampleHeader, SampleKind};
use crate::memory::sizes::padded;
use crate::qos::History;
use crate::topic::reader::borrowed::BorrowedSample;
use crate::topic::reader::receiver::{BorrowedChunk, TakeOutcome, TakenSample};
use crate::topic::subscription::{PollState, RawSubscription, SubscriptionCounters};
use core::pin::Pin;
use core::ptr::NonNull;
use core::sync::atomic::{AtomicU64, Ordering};
use core::task::{Context, Poll};
use futures::Stream;
use tautline_msgs::cdr::{DecodeError, DecodeFault, FieldPath};
use tautline_rt::clock::monotonic_ns;

/// A body in shared memory. A subscription lends at most `Limits::held` samples at once; they may be dropped in any
/// thread.
pub struct RawSample {
    /// The body and what follows it, up to a multiple of 8.
    payload: NonNull<[u8]>,
    body_bytes: usize,
    info: MessageInfo,
    kind: SampleKind,
    port_gid: Gid,
    port_sequence_number: u64,
    _lent: BorrowedSample<BorrowedChunk>,
}

// SAFETY: a RawSample reads its payload through `&[u8]`, and `_lent` may be dropped anywhere.
unsafe impl Send for RawSample {}
// SAFETY: as above.
unsafe impl Sync for RawSample {}

impl RawSample {
    /// The message's CDR, without the 4 encapsulation bytes, at an address that is a multiple of 8. It has not been
    /// checked whether it is a message of the topic's type.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn body(&self) -> &[u8] {
        self.payload().get(..self.body_bytes).unwrap_or_default()
    }

    /// The message as it is serialized: the [`body`](Self::body) behind its 4 encapsulation bytes, all in shared memory. `None` if it is
    /// no [message](Self::is_message).
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn serialized(&self) -> Option<&[u8]> {
        let len_bytes = ENCAPSULATION.len() + self.body().len();
        // SAFETY: the header lies before the payload, ends with the encapsulation, and is mapped and borrowed with it.
        let bytes = unsafe {
            let start = self.payload.cast::<u8>().byte_sub(ENCAPSULATION.len());
            std::slice::from_raw_parts(start.as_ptr().cast_const(), len_bytes)
        };
        self.is_message().then_some(bytes)
    }

    /// The body and what follows it, up to a multiple of 8.
    pub(crate) fn payload(&self) -> &[u8] {
        // SAFETY: `payload` are the bytes of a sample that `_lent` keeps borrowed and mapped. A publisher does not write
        // to a sample that a subscription holds.
        unsafe { self.payload.as_ref() }
    }

    /// Sequence number, time stamps, publisher.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn info(&self) -> MessageInfo {
        self.info
    }

    pub(crate) fn kind(&self) -> SampleKind {
        self.kind
    }

    /// Whether it is a message, and not a server's notice that there will be no response. Only clients and
    /// subscriptions of [`create_service_observer`](crate::Participant::create_service_observer) get such
    /// notices.
    pub fn is_message(&self) -> bool {
        self.kind == SampleKind::Message
    }

    /// The publisher on this host through which the message came: [`MessageInfo::publisher_gid`], unless the original
    /// publisher is on another host.
    pub fn port_gid(&self) -> Gid {
        self.port_gid
    }

    /// The message's number in that port, from 1, independent of its original publisher.
    pub fn port_sequence_number(&self) -> u64 {
        self.port_sequence_number
    }
}

impl core::fmt::Debug for RawSample {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("RawSample").field("body_bytes", &self.body_bytes).field("info", &self.info).finish()
    }
}

impl RawSubscription {
    /// Takes the oldest sample of a publisher, if there is one. Expired samples are skipped: after 16 of them in one call it
    /// returns `None` and rings this subscription's doorbell, as if the samples behind them had just been published.
    ///
    /// # Real-time
    /// Lock-free, O(publishers), at most 16 samples checked: if a publisher overwrites the sample that is being taken, the next one is
    /// taken. No allocation; no syscall, except one futex wake if a keep-all publisher waits for room and its sampler sleeps, one if
    /// messages were lost and a monitor watches for that, one if 16 samples were skipped and this process's sampler sleeps, and one
    /// for each publisher that has ended, or that sends from memory that is not mapped here yet.
    ///
    /// # Errors
    /// [`TakeError`]. A sample whose header is invalid is consumed.
    pub fn try_take(&self) -> Result<Option<RawSample>, TakeError> {
        let mut budget = PollBudget::new();
        let taken = self.take(&mut budget);
        if matches!(taken, Ok(None)) {
            self.ring_if_spent(&budget);
        }
        taken
    }

    /// Whether there is a sample to take; it may have expired.
    ///
    /// # Real-time
    /// Lock-free, O(publishers): if a publisher overwrites the checked sample, it checks again; no allocation; no syscall, except one
    /// futex wake if a sample lies in memory that is not mapped here yet.
    pub fn has_samples(&self) -> bool {
        let mut take_state = self.take_state.borrow_mut();
        take_state.refresh();
        take_state.has_samples(|outcome| self.note_outcome(outcome))
    }

    /// How many messages have arrived and were neither taken nor counted as lost. At most `depth` of them can still be
    /// taken.
    ///
    /// # Real-time
    /// O(publishers); no allocation; no syscall.
    pub fn waiting(&self) -> u64 {
        let mut take_state = self.take_state.borrow_mut();
        take_state.refresh();
        take_state.waiting()
    }

    /// Lets the next take begin with the sample that was released first: otherwise publishers have turns, and only each one's samples come in
    /// their order.
    ///
    /// # Real-time
    /// O(publishers); no allocation; no syscall.
    pub fn turn_to_oldest(&self) {
        let mut take_state = self.take_state.borrow_mut();
        take_state.refresh();
        take_state.turn_to_oldest();
    }

    /// Whether this publisher is connected, and has not ended.
    pub(crate) fn has_publisher(&self, publisher: Gid) -> bool {
        let mut take_state = self.take_state.borrow_mut();
        take_state.refresh();
        take_state.has(publisher)
    }

    /// Whether the participant of this port is in the domain: a participant that was cleaned up may still be in one of its
    /// topics' tables.
    pub(crate) fn has_participant_of(&self, port: Gid) -> bool {
        self.registration.participant.domain.members().any(|member| member.id == port.participant())
    }

    /// If the budget is spent, rings this subscription's doorbell, because there may be more samples behind the skipped ones.
    pub(crate) fn ring_if_spent(&self, budget: &PollBudget) {
        if budget.is_spent() {
            self.slot().ring();
        }
    }

    /// Takes the oldest sample, skipping expired ones. `None`: there is none, or the budget is spent.
    fn take(&self, budget: &mut PollBudget) -> Result<Option<RawSample>, TakeError> {
        if self.core().forgotten.load(Ordering::Relaxed) != 0 {
            self.note_lost(self.core().forgotten.swap(0, Ordering::Relaxed));
        }
        let mut take_state = self.take_state.borrow_mut();
        take_state.refresh();
        while !budget.is_spent() {
            if !self.borrowed.reclaim() {
                return Err(TakeError::TooManyHeld);
            }
            let Some(taken) = take_state.take(|outcome| self.note_outcome(outcome)) else {
                if self.stop_draining() {
                    // Again, for samples that were queued before their publisher could see that it must ring.
                    continue;
                }
                return Ok(None);
            };
            budget.spend();
            if self.core().qos.history == History::KeepAll {
                taken.receiver().ring_if_waiting();
            }
            if taken.lost != 0 {
                self.note_lost(taken.lost);
            }
            self.counters.note_queue(taken.waiting.min(self.core().qos.depth as u64));
            if has_expired(&taken.header) {
                add(&self.counters.expired, 1);
                continue;
            }
            add(&self.counters.received, 1);
            return self.lend(taken).map(Some);
        }
        Ok(None)
    }

    /// Handles an outcome other than a sample, and calls the janitor.
    #[cold]
    fn note_outcome(&self, outcome: &TakeOutcome) {
        match outcome {
            TakeOutcome::Settled(lost) if *lost != 0 => self.note_lost(*lost),
            // For the samples behind the skipped one.
            TakeOutcome::Passed => self.slot().ring(),
            _ => {}
        }
        if !self.core().has_called.swap(true, Ordering::AcqRel) {
            self.registration.participant.call_janitor();
        }
    }

    fn lend(&self, taken: TakenSample) -> Result<RawSample, TakeError> {
        let TakenSample { held, header, payload, .. } = taken;
        let port_gid = held.publisher();
        // The length is another process's claim.
        let (body_bytes, kind) = header.body();
        let Some(body) = body_within(payload, body_bytes) else {
            self.note_invalid();
            drop(held);
            let fault = DecodeFault::End { needed: body_bytes, left: payload.len() };
            let (type_name, path) = ("sample", FieldPath::EMPTY);
            return Err(TakeError::Invalid(DecodeError { type_name, path, offset: 0, fault }));
        };
        let lent = self.borrowed.lend(held).ok_or(TakeError::TooManyHeld)?;
        tautline_trace::take(self.trace.id(), &header.trace_id(port_gid, payload.addr().get()));
        Ok(RawSample {
            payload: body,
            body_bytes,
            info: header.info(),
            kind,
            port_gid,
            port_sequence_number: header.sequence_number,
            _lent: lent,
        })
    }

    /// Counts lost messages, and notifies monitors of the subscription.
    fn note_lost(&self, lost: u64) {
        add(&self.counters.lost, lost);
        let slot = self.slot();
        slot.doorbell().arena().ring_events(slot.index());
    }

    /// Counts a sample that is not a message of the type that its reader expects.
    pub(crate) fn note_invalid(&self) {
        add(&self.counters.invalid, 1);
    }

    /// Takes the oldest valid sample, if there is one. Invalid samples are counted and skipped, like those that
    /// [`try_take`](Self::try_take) skips: at most 16 of all kinds in one call. Refusals are counted.
    ///
    /// # Real-time
    /// As [`try_take`](Self::try_take).
    ///
    /// # Errors
    /// [`TakeError`], but not [`TakeError::Invalid`].
    pub fn try_take_valid(&self) -> Result<Option<RawSample>, TakeError> {
        let mut budget = PollBudget::new();
        let taken = self.take_valid(&mut budget);
        if matches!(taken, Ok(None)) {
            self.ring_if_spent(&budget);
        }
        taken
    }

    /// As [`try_take_valid`](Self::try_take_valid), without a ring when the budget is spent.
    pub(crate) fn take_valid(&self, budget: &mut PollBudget) -> Result<Option<RawSample>, TakeError> {
        loop {
            match self.take(budget) {
                Err(TakeError::Invalid(_)) => {}
                Err(refused) => {
                    add(&self.counters.refused, 1);
                    return Err(refused);
                }
                taken => return taken,
            }
        }
    }

    /// Polls for a sample. Registers the task before the check, so that a ring after the check wakes it. `None`: its node, if it has one,
    /// had ended before the check, and all samples that had arrived were delivered.
    ///
    /// # Real-time
    /// Like [`try_take_valid`](Self::try_take_valid), but the task itself is woken: after 16 skipped samples other tasks of the
    /// thread get a turn.
    pub fn poll_take(&self, context: &mut Context<'_>) -> Poll<Option<RawSample>> {
        self.poll_within(context, &mut PollBudget::new())
    }

    /// As [`poll_take`](Self::poll_take). Pending with the budget spent: there may be more, and the task is woken for it.
    pub(crate) fn poll_within(
        &self,
        context: &mut Context<'_>,
        budget: &mut PollBudget,
    ) -> Poll<Option<RawSample>> {
        self.slot().waker().register(context.waker());
        // Between the two: a node that ends later wakes the task, but samples that come after a node has ended may wake nobody.
        let has_ended = self.has_ended();
        while !budget.is_spent() {
            match self.take(budget) {
                Ok(Some(sample)) => {
                    self.note_taken();
                    return Poll::Ready(Some(sample));
                }
                Ok(None) if budget.is_spent() => break,
                Ok(None) if has_ended => return Poll::Ready(None),
                Ok(None) => return Poll::Pending,
                Err(TakeError::Invalid(_)) => {}
                // It may stay in the draining state, in which nobody rings: the return of a borrowed sample wakes the task.
                Err(TakeError::TooManyHeld) => {
                    add(&self.counters.refused, 1);
                    budget.spend();
                    if !self.borrowed.wake_when_back(context.waker()) {
                        budget.spend_all();
                        return Poll::Pending;
                    }
                }
            }
        }
        context.waker().wake_by_ref();
        Poll::Pending
    }

    /// Notes that a poll took a sample. The first may be the last, too; from the second on there is a backlog, in which rings are useless.
    fn note_taken(&self) {
        match self.poll_state.get() {
            PollState::Waiting => self.poll_state.set(PollState::Took),
            PollState::Took => {
                self.slot().flags().start_draining();
                self.poll_state.set(PollState::Draining);
            }
            PollState::Draining => {}
        }
    }

    /// Makes publishers ring again. True if they did not: then check the queue once more.
    fn stop_draining(&self) -> bool {
        let was_draining = self.poll_state.replace(PollState::Waiting) == PollState::Draining;
        if was_draining {
            self.slot().flags().stop_draining();
        }
        was_draining
    }
}

/// The part of a payload that holds a body of `body_bytes`. `None`: it is longer than the payload.
fn body_within(payload: NonNull<[u8]>, body_bytes: usize) -> Option<NonNull<[u8]>> {
    let is_there = body_bytes <= payload.len();
    is_there.then(|| NonNull::slice_from_raw_parts(payload.cast(), padded(body_bytes).min(payload.len())))
}

/// The maximum number of samples that one call checks: a publisher whose samples are all skipped must not keep a thread busy.
const POLL_BUDGET: usize = 16;

/// The number of samples that a call may still check.
pub(crate) struct PollBudget(usize);

impl PollBudget {
    pub(crate) fn new() -> Self {
        PollBudget(POLL_BUDGET)
    }

    fn spend(&mut self) {
        self.0 = self.0.saturating_sub(1);
    }

    fn spend_all(&mut self) {
        self.0 = 0;
    }

    /// Whether the call must stop, although there may be more samples.
    pub(crate) fn is_spent(&self) -> bool {
        self.0 == 0
    }
}

impl Stream for RawSubscription {
    type Item = RawSample;

    /// # Real-time
    /// As [`RawSubscription::try_take`]. Ends with its node, if it has one.
    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<RawSample>> {
        self.poll_take(context)
    }
}

impl SubscriptionCounters {
    fn note_queue(&self, waiting: u64) {
        if waiting > self.max_queue.load(Ordering::Relaxed) {
            self.max_queue.store(waiting, Ordering::Relaxed);
        }
    }
}

/// Whether the sample's lifespan is over. Without a lifespan the clock is not read.
fn has_expired(header: &SampleHeader) -> bool {
    header.expires_ns != NEVER && monotonic_ns() >= header.expires_ns
}

/// Only the subscription's thread writes its counters: a load and a store, no locked instruction.
pub(super) fn add(counter: &AtomicU64, n: u64) {
    counter.store(counter.load(Ordering::Relaxed).saturating_add(n), Ordering::Relaxed);
}
