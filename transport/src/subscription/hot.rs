// SPDX-License-Identifier: MIT OR Apache-2.0
//! Taking samples.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use super::{Counters, RawSubscription, Run, State};
use crate::doorbell::{ArenaId, Doorbell, Link, Slot};
use crate::error::{TakeError, TransportError};
use crate::header::{END_OF_HISTORY, Gid, MessageInfo, NEVER, SampleHeader};
use crate::lending::{Lent, Shelf, Sole};
use crate::ports::Reached;
use crate::qos::History;
use crate::sync::{Ordering, fence};
use crate::topic::{IoxSample, IoxSubscriber, bytes};
use core::pin::Pin;
use core::ptr::NonNull;
use core::sync::atomic::AtomicU64;
use core::task::{Context, Poll};
use futures::Stream;
use iceoryx2::port::ReceiveError;
use std::sync::Arc;
use tautline_msgs::cdr::{DecodeError, DecodeFault, FieldPath};
use tautline_rt::clock::monotonic_ns;

/// A body in shared memory. At most `Limits::held` of one subscription are alive at once; they may be dropped in any
/// thread.
pub struct RawSample {
    payload: NonNull<[u8]>,
    /// At most the payload's length.
    body_bytes: usize,
    info: MessageInfo,
    port_gid: Gid,
    port_sequence_number: u64,
    _lent: Lent<IoxSample>,
}

// SAFETY: a RawSample reads its payload through `&[u8]`, and `_lent` may be dropped anywhere.
unsafe impl Send for RawSample {}
// SAFETY: as above.
unsafe impl Sync for RawSample {}

impl RawSample {
    /// The message's CDR, without the 4 encapsulation bytes, at an address that is a multiple of 8. Nobody has looked
    /// whether it is a message of the topic's type.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn body(&self) -> &[u8] {
        self.payload().get(..self.body_bytes).unwrap_or_default()
    }

    /// The body and what follows it, up to a multiple of 8.
    pub(crate) fn payload(&self) -> &[u8] {
        // SAFETY: `payload` are the bytes of a sample that `_lent` keeps on its shelf, mapped. A publisher does not write
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

    /// The publisher on this host that the message came through: [`MessageInfo::publisher_gid`], unless that one is on
    /// another host.
    pub fn port_gid(&self) -> Gid {
        self.port_gid
    }

    /// Counts what went through that port, from 1, whoever published it first.
    pub fn port_sequence_number(&self) -> u64 {
        self.port_sequence_number
    }
}

impl core::fmt::Debug for RawSample {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("RawSample").field("body_bytes", &self.body_bytes).field("info", &self.info).finish()
    }
}

/// The doorbells of keep-all publishers that asked to be rung, kept mapped.
pub(super) struct Waiters {
    domain: u32,
    known: Vec<Reached>,
    capacity: usize,
}

impl Waiters {
    pub(super) fn new(domain: u32, capacity: usize) -> Self {
        Waiters { domain, known: Default::default(), capacity }
    }

    /// Rings the publisher of `link` if it waits for room. The first time for each process: maps its doorbell. If that cannot be
    /// mapped, the janitor goes on: the publisher would wait for ever.
    fn ring(&mut self, slot: &Slot, link: &Link) {
        // The take before is visible before the request is looked at; see the publisher's check for room.
        fence(Ordering::SeqCst);
        if link.out.waiting.load(Ordering::Relaxed) == 0 {
            return;
        }
        // It will see this request, and opens files where nobody waits for that.
        if self.position(link.waiter().0).is_none() && slot.is_left_to_janitor() {
            return;
        }
        if link.out.waiting.swap(0, Ordering::Relaxed) == 0 {
            return;
        }
        let (arena, waiter) = link.waiter();
        match self.reach(slot.doorbell(), arena) {
            Ok(Some(reached)) => reached.arena().bell().ring(waiter),
            // It has gone, and waits no longer.
            Ok(None) => {}
            Err(_) => {
                link.out.waiting.store(1, Ordering::Relaxed);
                slot.leave_to_janitor();
            }
        }
    }

    fn position(&self, arena: ArenaId) -> Option<usize> {
        self.known.iter().position(|reached| reached.arena().id() == arena)
    }

    #[allow(clippy::disallowed_methods, reason = "once for each process that publishes here")]
    fn reach(&mut self, own: &Arc<Doorbell>, arena: ArenaId) -> Result<Option<&Reached>, TransportError> {
        let position = match self.position(arena) {
            Some(position) => position,
            None => {
                let Some(reached) = Reached::reach(self.domain, own, arena)? else { return Ok(None) };
                if self.known.len() >= self.capacity {
                    self.known.clear();
                }
                self.known.push(reached);
                self.known.len() - 1
            }
        };
        Ok(self.known.get(position))
    }
}

impl RawSubscription {
    /// Takes the oldest sample of a publisher, if there is one. Samples that have expired, duplicates, and those of publishers that
    /// do not fit are passed over: after 16 in one call it returns `None` and rings this subscription's doorbell, as if what is
    /// behind them had just been published.
    ///
    /// # Real-time
    /// Wait-free, O(publishers), at most 16 samples looked at. No allocation; no syscall, except one futex wake if a keep-all
    /// publisher waits for room and its sampler sleeps, one if messages were lost and somebody watches for that, and one if 16 were
    /// passed over and this process's sampler sleeps. When publishers have appeared or gone since the last call, when one of them took
    /// a larger segment, and the first time that a keep-all publisher of another process waits for room (its doorbell is opened):
    /// allocates and maps memory.
    ///
    /// # Errors
    /// [`TakeError`]. A sample whose header is invalid is consumed.
    pub fn try_take(&self) -> Result<Option<RawSample>, TakeError> {
        let mut patience = Patience::new();
        let taken = self.take(&mut patience);
        if matches!(taken, Ok(None)) {
            self.go_on_later(&patience);
        }
        taken
    }

    /// If there may be more behind what was passed over: whoever waits for the doorbell comes again.
    pub(crate) fn go_on_later(&self, patience: &Patience) {
        if patience.is_over() {
            self.departure.slot.ring();
        }
    }

    /// Takes the oldest sample, passing over what is not for the user. `None`: there is none, or the patience is over.
    fn take(&self, patience: &mut Patience) -> Result<Option<RawSample>, TakeError> {
        let mut state = self.state.borrow_mut();
        if let Some(sample) = self.take_history(&mut state, patience)? {
            return Ok(Some(sample));
        }
        if state.catch.is_some() {
            // What is live comes after the history, whose end rings whatever the flags say.
            self.stop_draining();
            return Ok(None);
        }
        let slot = &self.departure.slot;
        let links = slot.doorbell().arena().links(slot.index());
        while !patience.is_over() {
            let epoch = slot.epoch();
            if epoch != state.epoch {
                state.epoch = epoch;
                state.tracker.note_ended(links);
            }
            let Some(sample) = receive(&self.port, &self.shelf)? else {
                if self.stop_draining() {
                    // What was queued before its publisher could see that it must ring again.
                    continue;
                }
                match state.tracker.settle(links) {
                    0 => {}
                    lost => self.note_lost(lost),
                }
                return Ok(None);
            };
            patience.spend();
            let header = *sample.user_header();
            if state.incompatible.contains(&header.gid) {
                continue;
            }
            let Some(noted) = state.tracker.note(header.gid, header.sequence_number, links) else { continue };
            if self.qos.history == History::KeepAll
                && let Some(link) = noted.link.and_then(|link| links.get(link))
            {
                state.waiters.ring(slot, link);
            }
            if noted.duplicate {
                continue;
            }
            if noted.lost != 0 {
                self.note_lost(noted.lost);
            }
            self.counters.note_queue(noted.waiting.min(self.qos.depth as u64));
            if has_expired(&header) {
                add(&self.counters.expired, 1);
                continue;
            }
            add(&self.counters.received, 1);
            return self.lend(sample, &self.shelf).map(Some);
        }
        Ok(None)
    }

    /// The next sample of the history, while that lasts.
    fn take_history(
        &self,
        state: &mut State,
        patience: &mut Patience,
    ) -> Result<Option<RawSample>, TakeError> {
        let slot = &self.departure.slot;
        let links = slot.doorbell().arena().links(slot.index());
        while let Some(catch) = &mut state.catch
            && !patience.is_over()
        {
            let received = match receive(&catch.inlet, &catch.shelf) {
                // Patience ends, whatever keeps the history from coming.
                Err(TakeError::Connection) if catch.is_complete() => None,
                received => received?,
            };
            let Some(sample) = received else {
                if catch.is_complete()
                    && let Some(catch) = state.catch.take()
                {
                    catch.finish();
                }
                return Ok(None);
            };
            patience.spend();
            let header = *sample.user_header();
            if header.expires_ns == END_OF_HISTORY {
                catch.end(header.gid);
            } else if !state.incompatible.contains(&header.gid)
                && state.tracker.note_history(header.gid, header.sequence_number, links)
            {
                if has_expired(&header) {
                    add(&self.counters.expired, 1);
                    continue;
                }
                add(&self.counters.received, 1);
                return self.lend(sample, &catch.shelf).map(Some);
            }
        }
        Ok(None)
    }

    fn lend(&self, sample: IoxSample, shelf: &Shelf<IoxSample>) -> Result<RawSample, TakeError> {
        let header = *sample.user_header();
        let payload = bytes(sample.payload());
        // The length is another process's claim.
        let body_bytes = usize::try_from(header.body_bytes).unwrap_or(usize::MAX);
        if body_bytes > payload.len() {
            self.note_invalid();
            let fault = DecodeFault::End { needed: body_bytes, left: payload.len() };
            let (type_name, path) = ("sample", FieldPath::EMPTY);
            return Err(TakeError::Invalid(DecodeError { type_name, path, offset: 0, fault }));
        }
        let payload = NonNull::from(payload);
        let lent = shelf.lend(sample).ok_or(TakeError::TooManyHeld)?;
        tautline_trace::take(self.trace.id(), &header.trace_id(payload.addr().get()));
        let (port_gid, port_sequence_number) = (header.gid, header.sequence_number);
        Ok(RawSample {
            payload,
            body_bytes,
            info: header.info(),
            port_gid,
            port_sequence_number,
            _lent: lent,
        })
    }

    /// Counts lost messages, and tells who wants to know: the only case in which a take rings.
    fn note_lost(&self, lost: u64) {
        add(&self.counters.lost, lost);
        let slot = &self.departure.slot;
        slot.doorbell().arena().ring_events(slot.index());
    }

    /// Counts a sample that is not a message of the type that its reader expects.
    pub(crate) fn note_invalid(&self) {
        add(&self.counters.invalid, 1);
    }

    /// Takes the oldest valid sample, if there is one. Invalid ones are counted and passed over, like those that
    /// [`try_take`](Self::try_take) passes over: 16 of all kinds in one call. Refusals are counted.
    ///
    /// # Real-time
    /// As [`try_take`](Self::try_take).
    ///
    /// # Errors
    /// [`TakeError`], but not [`TakeError::Invalid`].
    pub fn try_take_valid(&self) -> Result<Option<RawSample>, TakeError> {
        let mut patience = Patience::new();
        let taken = self.take_valid(&mut patience);
        if matches!(taken, Ok(None)) {
            self.go_on_later(&patience);
        }
        taken
    }

    /// As [`try_take_valid`](Self::try_take_valid), without a ring when the patience is over.
    pub(crate) fn take_valid(&self, patience: &mut Patience) -> Result<Option<RawSample>, TakeError> {
        loop {
            match self.take(patience) {
                Err(TakeError::Invalid(_)) => {}
                Err(refused) => {
                    add(&self.counters.refused, 1);
                    return Err(refused);
                }
                taken => return taken,
            }
        }
    }

    /// Polls for a sample. Registers the task before looking, so that a ring after the look wakes it.
    ///
    /// # Real-time
    /// As [`try_take_valid`](Self::try_take_valid), but the task is woken itself: after 16 samples that are passed over other tasks
    /// of the thread have a turn.
    pub fn poll_take(&self, context: &mut Context<'_>) -> Poll<RawSample> {
        self.poll_within(context, &mut Patience::new())
    }

    /// As [`poll_take`](Self::poll_take). Pending with the patience over: there may be more, and the task is woken for it.
    pub(crate) fn poll_within(&self, context: &mut Context<'_>, patience: &mut Patience) -> Poll<RawSample> {
        self.departure.slot.waker().register(context.waker());
        while !patience.is_over() {
            match self.take(patience) {
                Ok(Some(sample)) => {
                    self.note_taken();
                    return Poll::Ready(sample);
                }
                Ok(None) if patience.is_over() => break,
                Ok(None) => return Poll::Pending,
                Err(TakeError::Invalid(_)) => {}
                // Not rung for, so that it may drain on: the shelf wakes.
                Err(TakeError::TooManyHeld) => {
                    add(&self.counters.refused, 1);
                    patience.spend();
                    let state = self.state.borrow();
                    let shelf = state.catch.as_ref().map_or(&self.shelf, |catch| &catch.shelf);
                    if !shelf.wake_when_back(context.waker()) {
                        patience.end();
                        return Poll::Pending;
                    }
                }
                Err(TakeError::Connection) => {
                    add(&self.counters.refused, 1);
                    if !self.stop_draining() {
                        return Poll::Pending;
                    }
                }
            }
        }
        context.waker().wake_by_ref();
        Poll::Pending
    }

    /// The first of a row may be the last, too. From the second on it is a backlog, and while that lasts rings are for nothing.
    fn note_taken(&self) {
        match self.run.get() {
            Run::Waiting => self.run.set(Run::Took),
            Run::Took => {
                self.departure.slot.flags().start_draining();
                self.run.set(Run::Draining);
            }
            Run::Draining => {}
        }
    }

    /// Publishers ring again. Whether they did not: look into the queue once more.
    fn stop_draining(&self) -> bool {
        let was_draining = self.run.replace(Run::Waiting) == Run::Draining;
        if was_draining {
            self.departure.slot.flags().stop_draining();
        }
        was_draining
    }
}

/// A publisher that sends nothing but what is passed over must not keep a thread busy: so many are looked at in one call.
const LOOKS: usize = 16;

/// How many samples a call still looks at.
pub(crate) struct Patience(usize);

impl Patience {
    pub(crate) fn new() -> Self {
        Patience(LOOKS)
    }

    fn spend(&mut self) {
        self.0 = self.0.saturating_sub(1);
    }

    fn end(&mut self) {
        self.0 = 0;
    }

    /// There may be more, but another time.
    pub(crate) fn is_over(&self) -> bool {
        self.0 == 0
    }
}

impl Stream for RawSubscription {
    type Item = RawSample;

    /// # Real-time
    /// As [`RawSubscription::try_take`]. Never ends.
    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<RawSample>> {
        self.poll_take(context).map(Some)
    }
}

/// Receives only what has a place on the shelf.
fn receive(port: &Sole<IoxSubscriber>, shelf: &Shelf<IoxSample>) -> Result<Option<IoxSample>, TakeError> {
    if !shelf.reclaim() {
        return Err(TakeError::TooManyHeld);
    }
    port.get().receive().map_err(|error| match error {
        ReceiveError::ExceedsMaxBorrows => TakeError::TooManyHeld,
        ReceiveError::ConnectionFailure(_) => TakeError::Connection,
    })
}

impl Counters {
    fn note_queue(&self, waiting: u64) {
        if waiting > self.max_queue.load(Ordering::Relaxed) {
            self.max_queue.store(waiting, Ordering::Relaxed);
        }
    }
}

/// Whether its publisher's lifespan is over. Without one the clock is not read.
fn has_expired(header: &SampleHeader) -> bool {
    header.expires_ns != NEVER && monotonic_ns() >= header.expires_ns
}

/// Only the subscription's thread writes its counters: a load and a store, no locked instruction.
pub(super) fn add(counter: &AtomicU64, n: u64) {
    counter.store(counter.load(Ordering::Relaxed).saturating_add(n), Ordering::Relaxed);
}
