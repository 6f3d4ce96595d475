// SPDX-License-Identifier: MIT OR Apache-2.0
//! Loaning and publishing.
//!
//! In `publish`, in this order: the peers are brought up to date if the topic's epoch moved; room is checked if this
//! publisher keeps all; the header is written; iceoryx2 queues the sample at every subscription; the epoch is looked at
//! again, because a subscription that appeared meanwhile may have got the sample; the doorbells are rung.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use super::RawPublisher;
use super::peers::Peers;
use crate::doorbell::PulseOf;
use crate::error::{LoanError, PublishError};
use crate::header::{MessageInfo, NEVER, SampleHeader};
use crate::sync::{Ordering, fence};
use crate::topic::{IoxLoan, Word, bytes, bytes_mut, padded};
use core::future::poll_fn;
use core::ops::{Deref, DerefMut};
use core::task::Poll;
use tautline_rt::clock::{monotonic_ns, wall_ns};

/// A body to write in place: `&mut [u8]` in shared memory, at an address that is a multiple of 8. Dropping it gives it
/// back unsent.
pub struct RawLoan<'p> {
    publisher: &'p RawPublisher,
    sample: IoxLoan,
    len_bytes: usize,
}

/// A loan `L` that was not published.
pub enum Unpublished<L> {
    /// A keep-all subscription has no room. Nothing was sent; the loan is untouched.
    Full(L),
    /// The sample was spent: some subscriptions got it, the others count it as lost.
    Incomplete,
}

impl<L> Unpublished<L> {
    pub(crate) fn map<M>(self, change: impl FnOnce(L) -> M) -> Unpublished<M> {
        match self {
            Unpublished::Full(loan) => Unpublished::Full(change(loan)),
            Unpublished::Incomplete => Unpublished::Incomplete,
        }
    }
}

impl<L> core::fmt::Display for Unpublished<L> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Unpublished::Full(_) => PublishError::Full.fmt(f),
            Unpublished::Incomplete => PublishError::Incomplete.fmt(f),
        }
    }
}

impl<L> core::error::Error for Unpublished<L> {}

impl<L> core::fmt::Debug for Unpublished<L> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Unpublished::Full(_) => "Full",
            Unpublished::Incomplete => "Incomplete",
        })
    }
}

impl<L> From<Unpublished<L>> for PublishError {
    fn from(unpublished: Unpublished<L>) -> Self {
        match unpublished {
            Unpublished::Full(_) => PublishError::Full,
            Unpublished::Incomplete => PublishError::Incomplete,
        }
    }
}

/// What is left behind where there is no room.
#[derive(Clone, Copy, PartialEq, Eq)]
enum WhenFull {
    /// Nothing: the caller tries again when it likes.
    Leave,
    /// A request to be rung at the next take.
    Ask,
}

/// What a sample's header says of its origin.
enum Stamp {
    /// Published and released now.
    Now,
    /// Published now, released at this `CLOCK_MONOTONIC` time.
    ReleasedAt(u64),
    /// Published elsewhere, released now, to be delivered for so many nanoseconds.
    As(MessageInfo, u64),
}

impl RawPublisher {
    /// Loans a sample for a body of `len_bytes`. Its content is unspecified: zeros, or an earlier message of this publisher;
    /// write every byte.
    ///
    /// # Real-time
    /// Wait-free; one allocation of 48 bytes (iceoryx2's); no syscall. For a type without a fixed size, a body that is longer
    /// than `Limits::message_bytes` and than all before takes a larger segment: allocates, maps memory.
    ///
    /// # Errors
    /// [`LoanError::Exhausted`]: `Limits::loans` are out already. [`LoanError::TooLarge`]: longer than the topic's fixed size,
    /// rounded up to 8, or than `Limits::message_bytes` without `Limits::may_grow`, or than
    /// [`Limits::MAX_MESSAGE_BYTES`](crate::Limits::MAX_MESSAGE_BYTES). [`LoanError::OutOfMemory`].
    pub fn loan(&self, len_bytes: usize) -> Result<RawLoan<'_>, LoanError> {
        if len_bytes > crate::qos::Limits::MAX_MESSAGE_BYTES {
            return Err(LoanError::TooLarge);
        }
        let payload_bytes = padded(len_bytes);
        let grows = payload_bytes > self.capacity_bytes.get();
        if grows && !self.topic.limits.may_grow {
            return Err(LoanError::TooLarge);
        }
        let sample = self.port.loan_slice_uninit(payload_bytes / size_of::<Word>());
        let sample = sample.map_err(loan_error)?;
        if grows {
            self.note_growth(payload_bytes);
        }
        // SAFETY: the memory belongs to a mapped file, so every byte has a value: zero, or what was written last.
        let mut sample = unsafe { sample.assume_init() };
        // What is not the body's is zero, whatever was here before.
        bytes_mut(sample.payload_mut()).get_mut(len_bytes..).unwrap_or_default().fill(0);
        Ok(RawLoan { publisher: self, sample, len_bytes })
    }

    /// Copies `body` into a loan and publishes it.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan) and [`RawLoan::publish`], and one copy of the body.
    ///
    /// # Errors
    /// [`PublishError`]; nothing was sent unless it is [`PublishError::Incomplete`].
    pub fn publish(&self, body: &[u8]) -> Result<(), PublishError> {
        let mut loan = self.loan(body.len())?;
        loan.copy_from_slice(body);
        loan.publish().map_err(PublishError::from)
    }

    /// Publishes a loan. See [`RawLoan::publish`].
    fn publish_loan<'p>(
        &'p self,
        mut loan: RawLoan<'p>,
        stamp: Stamp,
        when_full: WhenFull,
    ) -> Result<(), Unpublished<RawLoan<'p>>> {
        if self.gate.as_ref().is_some_and(|gate| !gate.is_open()) {
            self.counters.silenced.fetch_add(1, Ordering::Relaxed);
            return Ok(());
        }
        let mut peers = self.peers.borrow_mut();
        peers.refresh_if_changed(&self.topic, &self.slot, self.gid);
        if self.keep_all && !has_room(&peers, when_full) {
            return Err(Unpublished::Full(loan));
        }
        let sequence_number = peers.sequence_number + 1;
        peers.sequence_number = sequence_number;
        let now_ns = monotonic_ns();
        let (released_ns, source, lifespan_ns) = match stamp {
            Stamp::As(source, left_ns) => (now_ns, source, left_ns.min(self.lifespan_ns)),
            Stamp::Now => (now_ns, self.info(sequence_number), self.lifespan_ns),
            Stamp::ReleasedAt(released_ns) => (released_ns, self.info(sequence_number), self.lifespan_ns),
        };
        *loan.sample.user_header_mut() = SampleHeader {
            sequence_number,
            gid: self.gid,
            released_ns,
            body_bytes: loan.len_bytes as u64,
            expires_ns: now_ns.saturating_add(lifespan_ns),
            source_timestamp_ns: source.source_timestamp_ns,
            source_sequence_number: source.sequence_number,
            source_gid: source.publisher_gid,
        };
        let address = loan.sample.payload().as_ptr().addr();
        tautline_trace::publish(self.trace.id(), &loan.sample.user_header().trace_id(address));
        for matched in &peers.matched {
            if let Some(link) = matched.link() {
                link.out.sent.store(sequence_number, Ordering::Relaxed);
            }
            matched.note_sample(now_ns);
        }
        if self.qos.deadline.is_some() {
            self.slot.note(PulseOf::Sample, now_ns);
        }
        if self.is_manual {
            self.show_life(&peers, now_ns);
        }
        let sent = loan.sample.send();
        // The sample is queued before the epoch is read and the bells are rung: a subscription that appears either is
        // seen here, or looks into its queue after this.
        fence(Ordering::SeqCst);
        peers.refresh_if_changed(&self.topic, &self.slot, self.gid);
        peers.ring();
        sent.map(|_| ()).map_err(|_| Unpublished::Incomplete)
    }

    /// Says that this publisher is alive, as publishing does: for one whose liveliness is manual and that has nothing to say.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions); no allocation; no syscall. When subscriptions have appeared or gone since the last call:
    /// allocates and maps memory.
    pub fn assert_liveliness(&self) {
        let mut peers = self.peers.borrow_mut();
        peers.refresh_if_changed(&self.topic, &self.slot, self.gid);
        self.show_life(&peers, monotonic_ns());
    }

    fn show_life(&self, peers: &Peers, now_ns: u64) {
        self.slot.note(PulseOf::Liveliness, now_ns);
        for link in peers.matched.iter().filter_map(|matched| matched.link()) {
            link.out.alive_ns.store(now_ns, Ordering::Relaxed);
        }
    }

    /// What this publisher's own message says of itself.
    fn info(&self, sequence_number: u64) -> MessageInfo {
        MessageInfo {
            sequence_number,
            source_timestamp_ns: wall_ns(),
            released_ns: 0,
            publisher_gid: self.gid,
        }
    }
}

fn loan_error(error: iceoryx2::port::LoanError) -> LoanError {
    use iceoryx2::port::LoanError as Iceoryx;
    match error {
        Iceoryx::ExceedsMaxLoans => LoanError::Exhausted,
        Iceoryx::ExceedsMaxLoanSize => LoanError::TooLarge,
        Iceoryx::OutOfMemory | Iceoryx::InternalFailure => LoanError::OutOfMemory,
    }
}

/// Whether each keep-all subscription can queue one more. Only this publisher fills its queues, so room stays room.
fn has_room(peers: &Peers, when_full: WhenFull) -> bool {
    let next = peers.sequence_number + 1;
    for matched in peers.matched.iter().filter(|matched| matched.keeps_all()) {
        let Some(link) = matched.link() else { continue };
        let full = || next.saturating_sub(link.taken.0.load(Ordering::Acquire)) > matched.depth;
        if full() {
            if when_full == WhenFull::Leave {
                return false;
            }
            // Ask to be rung, then look again: either the subscription sees the request or its take is seen here.
            link.out.waiting.store(1, Ordering::Relaxed);
            fence(Ordering::SeqCst);
            if full() {
                return false;
            }
        }
    }
    true
}

impl<'p> RawLoan<'p> {
    /// The whole payload: the body and the zeros that follow it, up to a multiple of 8.
    pub(crate) fn payload(&self) -> &[u8] {
        bytes(self.sample.payload())
    }

    /// As [`payload`](Self::payload).
    pub(crate) fn payload_mut(&mut self) -> &mut [u8] {
        bytes_mut(self.sample.payload_mut())
    }

    /// Publishes the sample to every subscription. It never waits: a slow keep-last subscription loses its oldest
    /// sample and counts it; with a full keep-all subscription, and if this publisher keeps all, nothing is sent and the
    /// loan comes back.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions); no allocation; at most one futex wake per sampler that sleeps, and per callback thread that
    /// sleeps and is woken directly; no other syscall.
    /// When ports of the topic have appeared or gone since the last call: allocates and maps memory.
    ///
    /// # Errors
    /// [`Unpublished`], with the loan if nothing was sent.
    pub fn publish(self) -> Result<(), Unpublished<RawLoan<'p>>> {
        self.publisher.publish_loan(self, Stamp::Now, WhenFull::Leave)
    }

    /// Publishes with a release time of the caller's: what response times are measured from, such as the instant at
    /// which a periodic publisher should have woken. In `CLOCK_MONOTONIC` nanoseconds.
    ///
    /// # Real-time
    /// As [`publish`](Self::publish).
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_released_at(self, released_ns: u64) -> Result<(), Unpublished<RawLoan<'p>>> {
        self.publisher.publish_loan(self, Stamp::ReleasedAt(released_ns), WhenFull::Leave)
    }

    /// Publishes a message that came from another host: subscriptions read its number, time stamp and publisher in their
    /// [`MessageInfo`]. It is released here and now, and losses are counted by this publisher's own numbers, so messages of
    /// many remote publishers may go through one port.
    ///
    /// # Real-time
    /// As [`publish`](Self::publish).
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_as(self, source: MessageInfo) -> Result<(), Unpublished<RawLoan<'p>>> {
        self.publisher.publish_loan(self, Stamp::As(source, NEVER), WhenFull::Leave)
    }

    /// As [`publish_as`](Self::publish_as); where there is no room, this publisher's slot is rung when a subscription has taken.
    pub(crate) fn publish_as_or_ask(self, source: MessageInfo) -> Result<(), Unpublished<RawLoan<'p>>> {
        self.publisher.publish_loan(self, Stamp::As(source, NEVER), WhenFull::Ask)
    }

    /// As [`publish_as`](Self::publish_as), for a message that is still to be delivered for `left`: what its publisher's lifespan
    /// leaves of it.
    ///
    /// # Real-time
    /// As [`publish`](Self::publish).
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_as_for(
        self,
        source: MessageInfo,
        left: core::time::Duration,
    ) -> Result<(), Unpublished<RawLoan<'p>>> {
        let left_ns = u64::try_from(left.as_nanos()).unwrap_or(NEVER);
        self.publisher.publish_loan(self, Stamp::As(source, left_ns), WhenFull::Leave)
    }

    /// Publishes as soon as every keep-all subscription has room. Only one loan of a publisher may wait at a time: a second
    /// one takes the first one's place, which then waits until it is polled for another reason.
    ///
    /// # Real-time
    /// Each poll as [`publish`](Self::publish); woken through this process's sampler when a subscription has taken.
    ///
    /// # Errors
    /// [`PublishError::Incomplete`].
    pub async fn publish_when_ready(self) -> Result<(), PublishError> {
        let mut waiting = Some(self);
        poll_fn(|context| {
            let Some(loan) = waiting.take() else { return Poll::Ready(Ok(())) };
            loan.publisher.slot.waker().register(context.waker());
            match loan.publisher.publish_loan(loan, Stamp::Now, WhenFull::Ask) {
                Ok(()) => Poll::Ready(Ok(())),
                Err(Unpublished::Full(loan)) => {
                    waiting = Some(loan);
                    Poll::Pending
                }
                Err(Unpublished::Incomplete) => Poll::Ready(Err(PublishError::Incomplete)),
            }
        })
        .await
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
