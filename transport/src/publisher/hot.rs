// SPDX-License-Identifier: MIT OR Apache-2.0
//! Loaning and publishing.
//!
//! In `publish`, in this order: the peers are brought up to date if the topic's epoch moved; room is checked if this
//! publisher keeps all; the header is written; iceoryx2 queues the sample at every subscription; the epoch is looked at
//! again, because a subscription that appeared meanwhile may have got the sample; the doorbells are rung.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use super::Publisher;
use super::peers::Peers;
use crate::error::{LoanError, PublishError};
use crate::header::SampleHeader;
use crate::sync::{Ordering, fence};
use crate::topic::IoxLoan;
use core::future::poll_fn;
use core::ops::{Deref, DerefMut};
use core::ptr::NonNull;
use core::task::Poll;
use tautline_msgs::{Message, Plain};
use tautline_rt::clock::{monotonic_ns, wall_ns};

/// A sample to write in place: `&mut T` in shared memory. Dropping it gives it back unsent.
pub struct Loan<'p, T: Message + Plain> {
    publisher: &'p Publisher<T>,
    sample: IoxLoan,
    body: NonNull<T>,
}

/// A loan that was not published.
pub enum Unpublished<'p, T: Message + Plain> {
    /// A keep-all subscription has no room. Nothing was sent; the loan is untouched.
    Full(Loan<'p, T>),
    /// The sample was spent: some subscriptions got it, the others count it as lost.
    Incomplete,
}

impl<T: Message + Plain> core::fmt::Display for Unpublished<'_, T> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Unpublished::Full(_) => PublishError::Full.fmt(f),
            Unpublished::Incomplete => PublishError::Incomplete.fmt(f),
        }
    }
}

impl<T: Message + Plain> core::error::Error for Unpublished<'_, T> {}

impl<T: Message + Plain> core::fmt::Debug for Unpublished<'_, T> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Unpublished::Full(_) => "Full",
            Unpublished::Incomplete => "Incomplete",
        })
    }
}

impl<T: Message + Plain> From<Unpublished<'_, T>> for PublishError {
    fn from(unpublished: Unpublished<'_, T>) -> Self {
        match unpublished {
            Unpublished::Full(_) => PublishError::Full,
            Unpublished::Incomplete => PublishError::Incomplete,
        }
    }
}

impl<T: Message + Plain> Publisher<T> {
    /// Loans a sample. Its content is a valid `T` but otherwise unspecified: zeros, or an earlier message of this
    /// publisher; write what the message needs.
    ///
    /// # Real-time
    /// Wait-free; one allocation of 48 bytes (iceoryx2's); no syscall. For a type with bool, char or enum fields,
    /// O(number of these) to check that the memory holds a valid `T`.
    ///
    /// # Errors
    /// [`LoanError::Exhausted`]: `Limits::loans` are out already.
    pub fn loan(&self) -> Result<Loan<'_, T>, LoanError> {
        let sample = self.port.loan_slice_uninit(size_of::<T>()).map_err(loan_error)?;
        // SAFETY: the memory belongs to a mapped file, so every byte has a value: zero, or what was written last.
        let mut sample = unsafe { sample.assume_init() };
        let bytes: &mut [u8] = sample.payload_mut();
        if bytes.len() != size_of::<T>() || bytes.as_ptr().align_offset(align_of::<T>()) != 0 {
            return Err(LoanError::TooLarge);
        }
        // Only this publisher writes here, and only whole `T`s; zeros are a valid `T` too. Another process that broke
        // the rules must still not make an invalid `T`.
        if !T::ALWAYS_VALID && T::validate(bytes).is_err() {
            bytes.fill(0);
        }
        let body = NonNull::from(bytes).cast::<T>();
        Ok(Loan { publisher: self, sample, body })
    }

    /// Copies `message` into a loan and publishes it.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan) and [`Loan::publish`], and one copy of the message.
    ///
    /// # Errors
    /// [`PublishError`]; nothing was sent unless it is [`PublishError::Incomplete`].
    pub fn publish(&self, message: &T) -> Result<(), PublishError> {
        let mut loan = self.loan()?;
        *loan = *message;
        loan.publish().map_err(PublishError::from)
    }

    /// Publishes a loan. See [`Loan::publish`].
    fn publish_loan<'p>(
        &'p self,
        mut loan: Loan<'p, T>,
        released_ns: Option<u64>,
    ) -> Result<(), Unpublished<'p, T>> {
        let mut peers = self.peers.borrow_mut();
        peers.refresh_if_changed(&self.topic, &self.slot, self.gid);
        if self.keep_all && !has_room(&peers) {
            return Err(Unpublished::Full(loan));
        }
        let sequence_number = peers.sequence_number + 1;
        peers.sequence_number = sequence_number;
        *loan.sample.user_header_mut() = SampleHeader {
            sequence_number,
            source_timestamp_ns: wall_ns(),
            released_ns: released_ns.unwrap_or_else(monotonic_ns),
            gid: self.gid,
            body_bytes: T::CDR_SIZE as u64,
            flags: 0,
        };
        for link in peers.matched.iter().filter_map(|matched| matched.link()) {
            link.out.sent.store(sequence_number, Ordering::Relaxed);
        }
        let sent = loan.sample.send();
        // The sample is queued before the epoch is read and the bells are rung: a subscription that appears either is
        // seen here, or looks into its queue after this.
        fence(Ordering::SeqCst);
        peers.refresh_if_changed(&self.topic, &self.slot, self.gid);
        peers.ring();
        sent.map(|_| ()).map_err(|_| Unpublished::Incomplete)
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
fn has_room(peers: &Peers) -> bool {
    let next = peers.sequence_number + 1;
    for matched in peers.matched.iter().filter(|matched| matched.keeps_all()) {
        let Some(link) = matched.link() else { continue };
        let full = || next.saturating_sub(link.taken.0.load(Ordering::Acquire)) > matched.depth;
        if full() {
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

impl<'p, T: Message + Plain> Loan<'p, T> {
    /// Publishes the sample to every subscription. It never waits: a slow keep-last subscription loses its oldest
    /// sample and counts it; with a full keep-all subscription, and if this publisher keeps all, nothing is sent and the
    /// loan comes back.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions); no allocation; at most one futex wake per sampler that sleeps, no other syscall.
    /// When ports of the topic have appeared or gone since the last call: allocates and maps memory.
    ///
    /// # Errors
    /// [`Unpublished`], with the loan if nothing was sent.
    pub fn publish(self) -> Result<(), Unpublished<'p, T>> {
        self.publisher.publish_loan(self, None)
    }

    /// Publishes with a release time of the caller's: what response times are measured from, such as the instant at
    /// which a periodic publisher should have woken. In `CLOCK_MONOTONIC` nanoseconds.
    ///
    /// # Real-time
    /// As [`publish`](Self::publish).
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_released_at(self, released_ns: u64) -> Result<(), Unpublished<'p, T>> {
        self.publisher.publish_loan(self, Some(released_ns))
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
            match loan.publish() {
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

impl<T: Message + Plain> Deref for Loan<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        // SAFETY: `body` points to a valid, aligned T (checked in `loan`) in memory that `sample` keeps.
        unsafe { self.body.as_ref() }
    }
}

impl<T: Message + Plain> DerefMut for Loan<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        // SAFETY: as in deref; the loan is borrowed mutably and no subscription has it yet.
        unsafe { self.body.as_mut() }
    }
}
