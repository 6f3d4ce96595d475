// SPDX-License-Identifier: MIT OR Apache-2.0
//! Loaning and publishing.
//!
//! Steps of `publish`, in this order: new and ended subscriptions are taken over; room is checked if this publisher keeps all; the
//! header is written; the sample is kept for late joiners, if required, and submitted to every subscription; the doorbells are
//! rung.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::error::{BurstError, LoanError, PublishError, SendError};
use crate::memory::header::{Gid, MessageInfo, NEVER, SampleHeader, SampleKind};
use crate::memory::pool::Segment;
use crate::memory::sizes::{padded, sample_bytes};
use crate::qos::Claim;
use crate::topic::publisher::RawPublisher;
use crate::topic::writer::sender::{PublishState, ReaderChannel};
use core::future::poll_fn;
use core::mem::ManuallyDrop;
use core::ops::{Deref, DerefMut};
use core::ptr::NonNull;
use core::sync::atomic::Ordering;
use core::task::Poll;
use tautline_doorbell::ActivityKind;
use tautline_rt::clock::{monotonic_ns, wall_ns};
use tautline_rt::{copy_to_shared, full_fence};

/// A body to write in place: `&mut [u8]` in shared memory, at an address that is a multiple of 8. Dropping it returns
/// the memory without sending.
pub struct RawLoan<'p> {
    publisher: &'p RawPublisher,
    /// It exists as long as one of its samples is in use, such as this one.
    segment: NonNull<Segment>,
    index: usize,
    payload: NonNull<[u8]>,
    len_bytes: usize,
}

/// What a publisher requests of a subscription whose queue is full.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum WhenFull {
    /// Nothing: the caller tries again later.
    Leave,
    /// Request a ring at the subscription's next take.
    Ask,
}

/// The origin in a sample's header.
#[derive(Clone, Copy)]
pub(crate) enum Stamp {
    /// Published and released now.
    Now,
    /// Published now, released at this `CLOCK_MONOTONIC` time.
    ReleasedAt(u64),
    /// For a service's request and its response: published and released now, identified by the client's
    /// information.
    OfRequest(MessageInfo),
    /// Published elsewhere, released now; may be delivered for this number of nanoseconds.
    As(MessageInfo, u64),
    /// Published earlier, and recorded: its number, if it is not 0, its time stamp, and the time of its new
    /// release.
    Again(MessageInfo),
}

/// What is sent, and to which subscriptions.
#[derive(Clone, Copy)]
pub(crate) struct Sending {
    pub(crate) stamp: Stamp,
    pub(crate) when_full: WhenFull,
    pub(crate) kind: SampleKind,
    /// To this subscription, and to observers.
    pub(crate) to: Option<Gid>,
}

impl Sending {
    const fn of(stamp: Stamp) -> Self {
        Sending { stamp, when_full: WhenFull::Leave, kind: SampleKind::Message, to: None }
    }
}

impl RawPublisher {
    /// Loans a sample for a body of `len_bytes`. Its content is unspecified: zeros, or an earlier message of this publisher;
    /// write every byte.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions), and O(samples + returned samples) if the list of free samples is empty; no allocation; no syscall. For
    /// a type without a fixed size, a body that is longer than `Limits::message_bytes` and than all bodies before needs a larger segment,
    /// and a publisher that claims memory on use may need more samples: allocates, maps memory, takes a lock, which inherits priority.
    ///
    /// # Errors
    /// [`LoanError::Exhausted`]: `Limits::loans` loans are already in use. [`LoanError::TooLarge`]: longer than the topic's
    /// fixed size, rounded up to 8, or than `Limits::message_bytes` without `Limits::may_grow`, or than
    /// [`Limits::MAX_MESSAGE_BYTES`](crate::Limits::MAX_MESSAGE_BYTES). [`LoanError::OutOfMemory`]. [`LoanError::Forked`] in a child.
    pub fn loan(&self, len_bytes: usize) -> Result<RawLoan<'_>, LoanError> {
        if len_bytes > self.most_bytes {
            return Err(LoanError::TooLarge);
        }
        if !self.process.is_here() {
            return Err(LoanError::Forked);
        }
        if self.core.slot.is_retired() {
            return Err(LoanError::Ended);
        }
        if self.loaned.get() >= self.core.limits.loans {
            return Err(LoanError::Exhausted);
        }
        let mut publish_state = self.publish_state.borrow_mut();
        publish_state.refresh(self.core.history.as_ref());
        if sample_bytes(len_bytes) > publish_state.table().pool.sample_bytes {
            self.lengthen(len_bytes, publish_state.table().pool.sample_bytes)?;
            publish_state.refresh(self.core.history.as_ref());
        }
        let (segment, index) = match take_returned(&mut publish_state) {
            Some(taken) => taken,
            None => {
                self.claiming().claim_more()?;
                publish_state.refresh(self.core.history.as_ref());
                take(&publish_state).ok_or(LoanError::OutOfMemory)?
            }
        };
        // SAFETY: the segment is in the table, and stays while one of its samples has a reference, which this one has now.
        let payload = unsafe { segment.as_ref() }.payload(index);
        self.loaned.set(self.loaned.get() + 1);
        let mut loan = RawLoan { publisher: self, segment, index, payload, len_bytes };
        // The padding after the body is zero, whatever the sample contained before.
        let padded = padded(len_bytes);
        if let Some(rest) = loan.all_mut().get_mut(len_bytes..padded) {
            rest.fill(0);
        }
        Ok(loan)
    }

    /// Whether a loan of `len_bytes` claims no memory. If not, a [`MemoryClaimer`](crate::MemoryClaimer) can claim it before the loan, in another thread.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan), but it never claims memory.
    pub fn has_memory(&self, len_bytes: usize) -> bool {
        if len_bytes > self.most_bytes {
            // The loan returns the error.
            return true;
        }
        let mut publish_state = self.publish_state.borrow_mut();
        publish_state.refresh(self.core.history.as_ref());
        if sample_bytes(len_bytes) > publish_state.table().pool.sample_bytes {
            return false;
        }
        let Some((segment, index)) = take_returned(&mut publish_state) else { return false };
        // SAFETY: the segment is in the table, and stays while one of its samples has a reference, which this one has until here.
        publish_state.table().pool.release(unsafe { segment.as_ref() }, index);
        true
    }

    /// Makes samples longer from now on.
    #[cold]
    fn lengthen(&self, len_bytes: usize, before: usize) -> Result<(), LoanError> {
        let after = self.claiming().lengthen(len_bytes)?;
        // A publisher that claims on use expects this. It claims the sample next, which is counted.
        if self.core.limits.claim == Claim::Ahead {
            self.counters.growths.fetch_add(1, Ordering::Relaxed);
            self.warn_of_growth(len_bytes, before, after);
        }
        Ok(())
    }

    /// Copies `body` into a loan and publishes it.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan) and [`RawLoan::publish`], and one copy of the body.
    ///
    /// # Errors
    /// [`PublishError`]; nothing was sent.
    pub fn publish(&self, body: &[u8]) -> Result<(), PublishError> {
        let mut loan = self.loan(body.len())?;
        copy_to_shared(&mut loan, body);
        loan.publish().map_err(PublishError::from)
    }

    /// Copies each body into a loan and publishes it, in this order, and rings each subscription once, when all are queued or one was not
    /// published. Messages for a keep-last subscription beyond its depth overwrite the oldest.
    ///
    /// # Real-time
    /// As [`publish`](Self::publish) for each body, but with one fence and one ring for all.
    ///
    /// # Errors
    /// [`BurstError`]: the bodies before that one were published.
    pub fn publish_many<'b>(
        &self,
        bodies: impl IntoIterator<Item = &'b [u8]>,
    ) -> Result<usize, BurstError<PublishError>> {
        self.publish_each(bodies, |body| {
            let mut loan = self.loan(body.len())?;
            copy_to_shared(&mut loan, body);
            Ok(loan)
        })
    }

    /// Publishes each message in the loan that `loan` makes of it, and rings at the end.
    pub(crate) fn publish_each<'p, M, E: From<PublishError>>(
        &'p self,
        messages: impl IntoIterator<Item = M>,
        mut loan: impl FnMut(M) -> Result<RawLoan<'p>, E>,
    ) -> Result<usize, BurstError<E>> {
        // Its drop rings, also if `messages` or `loan` panics.
        let mut burst = Burst { publisher: self, must_ring: false };
        let mut published = 0;
        for message in messages {
            let sent = loan(message).and_then(|loan| {
                let sent = self.queue(loan, Sending::of(Stamp::Now));
                sent.map_err(|unsent| E::from(unsent.error))
            });
            burst.must_ring |= sent.map_err(|error| BurstError { published, error })?;
            self.publish_state.borrow().table().pool.fetch_next();
            published += 1;
        }
        Ok(published)
    }

    /// Publishes a loan. See [`RawLoan::publish`].
    pub(crate) fn publish_loan<'p>(
        &'p self,
        loan: RawLoan<'p>,
        sending: Sending,
    ) -> Result<(), SendError<RawLoan<'p>>> {
        if self.queue(loan, sending)? {
            self.ring(sending.to);
        }
        self.publish_state.borrow().table().pool.fetch_next();
        Ok(())
    }

    /// Submits a loan to each subscription, which the caller must [ring](Self::ring) then. Returns false if nothing was sent.
    fn queue<'p>(&'p self, loan: RawLoan<'p>, sending: Sending) -> Result<bool, SendError<RawLoan<'p>>> {
        if self.gate.as_ref().is_some_and(|gate| !gate.is_open()) {
            self.counters.silenced.fetch_add(1, Ordering::Relaxed);
            return Ok(false);
        }
        let core = &*self.core;
        let mut publish_state = self.publish_state.borrow_mut();
        publish_state.refresh(core.history.as_ref());
        if self.keep_all && !has_room(&publish_state, sending) {
            return Err(SendError { error: PublishError::Full, loan });
        }
        if publish_state.table().claims_on_use && !self.claim_queues(&publish_state, sending.to) {
            return Err(SendError { error: LoanError::OutOfMemory.into(), loan });
        }
        let number = publish_state.next_number(sending.to);
        let (source, lifespan_ns) = match sending.stamp {
            Stamp::As(source, left_ns) => (source, left_ns.min(self.lifespan_ns)),
            Stamp::OfRequest(source) => (source, self.lifespan_ns),
            Stamp::Again(source) => {
                let number = if source.sequence_number == 0 { number } else { source.sequence_number };
                let publisher_gid = self.core.gid;
                (MessageInfo { sequence_number: number, publisher_gid, ..source }, self.lifespan_ns)
            }
            Stamp::Now | Stamp::ReleasedAt(_) => (self.info(number), self.lifespan_ns),
        };
        // After that: nothing appears before it was published.
        let now_ns = monotonic_ns();
        let released_ns = match sending.stamp {
            Stamp::ReleasedAt(released_ns) | Stamp::Again(MessageInfo { released_ns, .. }) => released_ns,
            _ => now_ns,
        };
        let mut header = SampleHeader {
            sequence_number: number,
            released_ns,
            expires_ns: now_ns.saturating_add(lifespan_ns),
            source_timestamp_ns: source.source_timestamp_ns,
            source_sequence_number: source.sequence_number,
            source_gid: source.publisher_gid,
            ..SampleHeader::default()
        };
        header.set_body(loan.len_bytes, sending.kind);
        if let Stamp::As(..) = sending.stamp {
            let from = source.publisher_gid.words();
            tautline_trace::pass(self.trace.id(), number, from, source.sequence_number);
        }
        tautline_trace::publish(self.trace.id(), &header.trace_id(core.gid, loan.payload.addr().get()));
        let len_bytes = loan.len_bytes;
        let (segment, index) = loan.into_sample();
        // SAFETY: the sample has a reference until the end of this, so its segment stays.
        let segment = unsafe { segment.as_ref() };
        // SAFETY: it was loaned, so nobody else uses it.
        unsafe { segment.header(index).write(header) };
        let chunk = segment.offset(index).to_word();
        if core.qos.deadline.is_some() {
            core.slot.note(ActivityKind::Sample, now_ns);
        }
        if self.is_manual {
            self.assert_liveliness_at(&publish_state, now_ns);
        }
        let pool = &publish_state.table().pool;
        if let Some(history) = &core.history {
            segment.add(index);
            if let Some((former, former_index)) = history.keep(number, chunk).and_then(|word| pool.find(word))
            {
                pool.release(former, former_index);
            }
        }
        for sender in publish_state.table().receiving(sending.to) {
            segment.add(index);
            sender.note_sample(now_ns);
            // SAFETY: it is live, so its sending half is this thread's.
            unsafe {
                // An observer has its own numbers for samples that are sent to others, as each of these has.
                let is_others = sending.to.is_some_and(|to| to != sender.subscription);
                sender.submit(if is_others { sender.next_own() } else { number }, chunk, pool);
            }
        }
        pool.release(segment, index);
        // Release: pairs with the Acquire of the setup code of a late joiner; the history has the sample.
        core.published.store(publish_state.sequence_number, Ordering::Release);
        core.traffic.note(len_bytes, now_ns);
        Ok(true)
    }

    /// Rings the subscriptions for which samples were [queued](Self::queue).
    fn ring(&self, to: Option<Gid>) {
        let history = self.core.history.as_ref();
        let mut publish_state = self.publish_state.borrow_mut();
        // The samples are queued before the flags are read and the bells are rung: a subscription either is rung, or looks into its queue
        // after this. And a late joiner that has been set up meanwhile either was given these samples, or gets them here.
        full_fence();
        if history.is_some() {
            publish_state.refresh(history);
        }
        publish_state.ring(to);
    }

    /// Claims the memory of queues that one more sample needs. Returns false if there is none.
    #[cold]
    fn claim_queues(&self, publish_state: &PublishState, to: Option<Gid>) -> bool {
        publish_state.table().receiving(to).all(|sender| {
            // SAFETY: it is live, so its sending half is this thread's.
            unsafe { sender.claim(|samples| self.core.claim_queues(sender.subscription, samples).is_ok()) }
        })
    }

    /// Asserts that this publisher is alive, as publishing does: for publishers with manual liveliness that have nothing to
    /// publish.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions); no allocation; no syscall.
    pub fn assert_liveliness(&self) {
        let mut publish_state = self.publish_state.borrow_mut();
        publish_state.refresh(self.core.history.as_ref());
        self.assert_liveliness_at(&publish_state, monotonic_ns());
    }

    fn assert_liveliness_at(&self, publish_state: &PublishState, now_ns: u64) {
        self.core.slot.note(ActivityKind::Liveliness, now_ns);
        for sender in publish_state.table().receiving(None) {
            sender.block().out.alive_ns.store(now_ns, Ordering::Relaxed);
        }
    }

    /// The information about a message of this publisher's own.
    fn info(&self, sequence_number: u64) -> MessageInfo {
        MessageInfo {
            sequence_number,
            source_timestamp_ns: wall_ns(),
            released_ns: 0,
            publisher_gid: self.core.gid,
        }
    }

    /// Whether every existing subscription has taken all samples that were sent, as far as known. Subscriptions that appear or
    /// disappear meanwhile may or may not count.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions); no allocation; no syscall.
    pub fn is_taken(&self) -> bool {
        let mut publish_state = self.publish_state.borrow_mut();
        publish_state.refresh(self.core.history.as_ref());
        // Acquire: pairs with the Release of the subscription's take.
        let is_taken = |sender: &ReaderChannel| {
            sender.block().back.taken.load(Ordering::Acquire)
                >= sender.block().out.sent.load(Ordering::Relaxed)
        };
        publish_state.table().receiving(None).filter(|sender| !sender.is_observer).all(is_taken)
    }

    /// The subscription whose client sends requests through the port `partner`, if responses to it arrive.
    pub(crate) fn subscription_of(&self, partner: Gid) -> Option<Gid> {
        let mut publish_state = self.publish_state.borrow_mut();
        publish_state.refresh(self.core.history.as_ref());
        let [participant, number] = partner.words();
        let is_it = |sender: &&ReaderChannel| {
            sender.partner == Some(number) && sender.subscription.participant() == participant
        };
        publish_state.table().receiving(None).find(is_it).map(|sender| sender.subscription)
    }
}

/// Samples that are published one after the other.
struct Burst<'p> {
    publisher: &'p RawPublisher,
    /// Samples are queued, and not rung for yet.
    must_ring: bool,
}

impl Drop for Burst<'_> {
    /// # Real-time
    /// As the end of [`RawLoan::publish`].
    fn drop(&mut self) {
        if self.must_ring {
            self.publisher.ring(None);
        }
    }
}

/// A free sample of the size that is loaned.
fn take(publish_state: &PublishState) -> Option<(NonNull<Segment>, usize)> {
    let (segment, index) = publish_state.table().pool.take()?;
    Some((NonNull::from(segment), index))
}

/// As [`take`], after subscriptions have returned samples: all of them only if no other sample is free, otherwise twice as many as were
/// loaned meanwhile. So what is returned at once, as by a recorder, is spread over some loans, and yet no more is in use than the queues
/// have room for. Samples that setup code has freed are searched last.
fn take_returned(publish_state: &mut PublishState) -> Option<(NonNull<Segment>, usize)> {
    publish_state.reclaim_some();
    take(publish_state).or_else(|| {
        publish_state.reclaim_all();
        publish_state.table().pool.list_free();
        take(publish_state)
    })
}

/// Whether the queue of each keep-all subscription has room for one more. Only this publisher fills its queues, so room stays room.
fn has_room(publish_state: &PublishState, sending: Sending) -> bool {
    let is_asked = sending.when_full == WhenFull::Ask;
    // SAFETY: they are live, so their sending halves are this thread's.
    let has_room = |sender: &ReaderChannel| unsafe { sender.has_room(is_asked) };
    publish_state.table().receiving(sending.to).filter(|sender| sender.keeps_all).all(has_room)
}

impl<'p> RawLoan<'p> {
    /// The whole payload: the body and the zeros that follow it, up to a multiple of 8.
    pub(crate) fn payload(&self) -> &[u8] {
        // SAFETY: the sample is this loan's; the memory is mapped, so every byte has a value.
        let all = unsafe { self.payload.as_ref() };
        all.get(..padded(self.len_bytes)).unwrap_or_default()
    }

    pub(crate) fn payload_mut(&mut self) -> &mut [u8] {
        let padded = padded(self.len_bytes);
        self.all_mut().get_mut(..padded).unwrap_or_default()
    }

    fn all_mut(&mut self) -> &mut [u8] {
        // SAFETY: as in `payload`; and `&mut self` is the only way to it.
        unsafe { self.payload.as_mut() }
    }

    /// Shortens the body to its first `len_bytes` bytes, if it is longer: for callers that loaned the maximum
    /// length of a message.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn truncate(&mut self, len_bytes: usize) {
        if len_bytes < self.len_bytes {
            self.len_bytes = len_bytes;
            // The padding after the body is zero.
            if let Some(rest) = self.payload_mut().get_mut(len_bytes..) {
                rest.fill(0);
            }
        }
    }

    /// Ends the loan. Returns the sample, which has one reference.
    fn into_sample(self) -> (NonNull<Segment>, usize) {
        let loan = ManuallyDrop::new(self);
        loan.publisher.loaned.set(loan.publisher.loaned.get() - 1);
        (loan.segment, loan.index)
    }

    pub(crate) fn publish_with(self, sending: Sending) -> Result<(), SendError<RawLoan<'p>>> {
        self.publisher.publish_loan(self, sending)
    }

    /// Publishes the sample to every subscription. It never waits: a slow keep-last subscription loses its oldest
    /// sample and counts it; with a full keep-all subscription, and if this publisher keeps all, nothing is sent and the
    /// loan comes back.
    ///
    /// # Real-time
    /// As [`loan`](RawPublisher::loan), O(subscriptions); no allocation; at most one futex wake per sampler that sleeps, and per
    /// callback thread that sleeps and is woken directly; no other syscall.
    /// When subscriptions have appeared or disappeared since the last call: in addition O(subscriptions x samples / 64). A
    /// publisher whose memory is claimed on use may make system calls and take a lock, which inherits priority, until its queues have
    /// all of their memory: once for each page of each queue.
    ///
    /// # Errors
    /// [`SendError`], with the loan: nothing was sent.
    pub fn publish(self) -> Result<(), SendError<RawLoan<'p>>> {
        self.publish_with(Sending::of(Stamp::Now))
    }

    /// Publishes with a release time set by the caller, in `CLOCK_MONOTONIC` nanoseconds. Response times are
    /// measured from the release time, for example the time at which a periodic publisher should have woken.
    ///
    /// # Real-time and errors
    /// As [`publish`](Self::publish).
    pub fn publish_released_at(self, released_ns: u64) -> Result<(), SendError<RawLoan<'p>>> {
        self.publish_with(Sending::of(Stamp::ReleasedAt(released_ns)))
    }

    /// Publishes a message that came from another host: subscriptions read its number, time stamp and publisher in their
    /// [`MessageInfo`]. Its release time is now, and losses are counted by this publisher's own numbers, so messages of
    /// many remote publishers may go through one port.
    ///
    /// # Real-time and errors
    /// As [`publish`](Self::publish).
    pub fn publish_as(self, source: MessageInfo) -> Result<(), SendError<RawLoan<'p>>> {
        self.publish_with(Sending::of(Stamp::As(source, NEVER)))
    }

    /// Like [`publish_as`](Self::publish_as), for a message that may still be delivered for the time `left`, the rest of its
    /// publisher's lifespan.
    ///
    /// # Real-time and errors
    /// As [`publish`](Self::publish).
    pub fn publish_as_for(
        self,
        source: MessageInfo,
        left: core::time::Duration,
    ) -> Result<(), SendError<RawLoan<'p>>> {
        let left_ns = u64::try_from(left.as_nanos()).unwrap_or(NEVER);
        self.publish_with(Sending::of(Stamp::As(source, left_ns)))
    }

    /// Publishes a recorded message: subscriptions read in their [`MessageInfo`] its recorded number and time stamp (for the number 0,
    /// this publisher's number), and `source.released_ns` as its new release time. The message still counts as one of this publisher.
    ///
    /// # Real-time and errors
    /// As [`publish`](Self::publish).
    pub fn publish_again(self, source: MessageInfo) -> Result<(), SendError<RawLoan<'p>>> {
        self.publish_with(Sending::of(Stamp::Again(source)))
    }

    /// Publishes as soon as every keep-all subscription has room. Only one loan of a publisher may wait at a time: a second
    /// one replaces the first, which then waits until it is polled for another reason.
    ///
    /// # Real-time
    /// Each poll as [`publish`](Self::publish); woken through this process's sampler when a subscription has taken.
    ///
    /// # Errors
    /// [`PublishError::Loan`]: out of memory, or the publisher's node has ended.
    pub async fn publish_when_ready(self) -> Result<(), PublishError> {
        let mut waiting = Some(self);
        poll_fn(|context| {
            let Some(loan) = waiting.take() else { return Poll::Ready(Ok(())) };
            loan.publisher.core.slot.waker().register(context.waker());
            match loan.publish_with(Sending { when_full: WhenFull::Ask, ..Sending::of(Stamp::Now) }) {
                Ok(()) => Poll::Ready(Ok(())),
                // The end of its node wakes this task.
                Err(SendError { error: PublishError::Full, loan })
                    if loan.publisher.core.slot.is_retired() =>
                {
                    Poll::Ready(Err(LoanError::Ended.into()))
                }
                Err(SendError { error: PublishError::Full, loan }) => {
                    waiting = Some(loan);
                    Poll::Pending
                }
                Err(refused) => Poll::Ready(Err(refused.error)),
            }
        })
        .await
    }
}

impl Drop for RawLoan<'_> {
    /// # Real-time
    /// As [`loan`](RawPublisher::loan), O(1).
    fn drop(&mut self) {
        self.publisher.loaned.set(self.publisher.loaned.get() - 1);
        // SAFETY: the sample has this loan's reference until here, so its segment is there.
        let segment = unsafe { self.segment.as_ref() };
        match self.publisher.publish_state.try_borrow() {
            Ok(publish_state) => publish_state.table().pool.release(segment, self.index),
            // The sample is listed when no other is free.
            Err(_) => _ = segment.release(self.index),
        }
    }
}

impl Deref for RawLoan<'_> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        self.payload().get(..self.len_bytes).unwrap_or_default()
    }
}

impl DerefMut for RawLoan<'_> {
    fn deref_mut(&mut self) -> &mut [u8] {
        let len_bytes = self.len_bytes;
        self.payload_mut().get_mut(..len_bytes).unwrap_or_default()
    }
}
