// SPDX-License-Identifier: MIT OR Apache-2.0
//! Loans and samples that are a `T` in shared memory.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use super::{Publisher, Subscription};
use crate::error::{LoanError, PublishError, TakeError};
use crate::header::MessageInfo;
use crate::publisher::{RawLoan, Unpublished};
use crate::subscription::RawSample;
use core::ops::{Deref, DerefMut};
use core::pin::Pin;
use core::ptr::NonNull;
use core::task::{Context, Poll};
use futures::Stream;
use tautline_msgs::{Invalid, Message, Plain};

/// A sample to write in place: `&mut T` in shared memory. Dropping it gives it back unsent.
pub struct Loan<'p, T: Message + Plain> {
    raw: RawLoan<'p>,
    body: NonNull<T>,
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
        let mut raw = self.raw.loan(T::CDR_SIZE)?;
        let bytes = raw.payload_mut();
        if bytes.len() < size_of::<T>() || bytes.as_ptr().align_offset(align_of::<T>()) != 0 {
            return Err(LoanError::TooLarge);
        }
        // Only this publisher writes here, and only whole `T`s; zeros are a valid `T` too. Another process that broke
        // the rules must still not make an invalid `T`.
        if !T::ALWAYS_VALID && T::validate(bytes).is_err() {
            bytes.fill(0);
        }
        let body = NonNull::from(bytes).cast::<T>();
        Ok(Loan { raw, body })
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
    pub fn publish(self) -> Result<(), Unpublished<Loan<'p, T>>> {
        let body = self.body;
        self.raw.publish().map_err(|unpublished| unpublished.map(|raw| Loan { raw, body }))
    }

    /// Publishes with a release time of the caller's: what response times are measured from, such as the instant at
    /// which a periodic publisher should have woken. In `CLOCK_MONOTONIC` nanoseconds.
    ///
    /// # Real-time
    /// As [`publish`](Self::publish).
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_released_at(self, released_ns: u64) -> Result<(), Unpublished<Loan<'p, T>>> {
        let body = self.body;
        let published = self.raw.publish_released_at(released_ns);
        published.map_err(|unpublished| unpublished.map(|raw| Loan { raw, body }))
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
        self.raw.publish_when_ready().await
    }
}

impl<T: Message + Plain> Deref for Loan<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        // SAFETY: `body` points to a valid, aligned T (checked in `loan`) in memory that `raw` keeps.
        unsafe { self.body.as_ref() }
    }
}

impl<T: Message + Plain> DerefMut for Loan<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        // SAFETY: as in deref; the loan is borrowed mutably and no subscription has it yet.
        unsafe { self.body.as_mut() }
    }
}

/// A message in shared memory: derefs to `T`. At most `Limits::held` of one subscription are alive at once; they may be
/// dropped in any thread.
pub struct Sample<T> {
    raw: RawSample,
    body: NonNull<T>,
}

// SAFETY: a Sample reads its body through `&T`, and `raw` is Send.
unsafe impl<T: Sync> Send for Sample<T> {}
// SAFETY: as above; `raw` is Sync.
unsafe impl<T: Sync> Sync for Sample<T> {}

impl<T> Sample<T> {
    /// Sequence number, time stamps, publisher.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn info(&self) -> MessageInfo {
        self.raw.info()
    }

    /// The sample's bytes.
    pub fn raw(&self) -> &RawSample {
        &self.raw
    }
}

impl<T: Message + Plain> Sample<T> {
    /// Checks the bytes once.
    fn new(raw: RawSample) -> Result<Self, Invalid> {
        let len = raw.body().len();
        // Longer by what alignment can explain is the same type; longer than that is another.
        if !(T::CDR_SIZE..=T::CDR_SIZE + 8).contains(&len) {
            return Err(Invalid::Length { type_name: T::TYPE_NAME, needed: T::CDR_SIZE, len });
        }
        let body = NonNull::from(tautline_msgs::from_bytes::<T>(raw.payload())?);
        Ok(Sample { raw, body })
    }
}

impl<T> Deref for Sample<T> {
    type Target = T;

    fn deref(&self) -> &T {
        // SAFETY: `body` was made from the bytes of `raw`, checked to be a valid T; they stay where and as they are as long
        // as `raw` lives.
        unsafe { self.body.as_ref() }
    }
}

impl<T: core::fmt::Debug> core::fmt::Debug for Sample<T> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        (**self).fmt(f)
    }
}

impl<T: Message + Plain> Subscription<T> {
    /// Takes the oldest sample of a publisher, if there is one.
    ///
    /// # Real-time
    /// Wait-free, O(publishers); no allocation; no syscall, except one futex wake if a keep-all publisher waits for room
    /// and its sampler sleeps. For types with bool, char or enum fields, O(number of these). When publishers have
    /// appeared or gone since the last call: allocates and maps memory.
    ///
    /// # Errors
    /// [`TakeError`]. An invalid sample is consumed.
    pub fn try_take(&self) -> Result<Option<Sample<T>>, TakeError> {
        let Some(raw) = self.raw.try_take()? else { return Ok(None) };
        self.check(raw).map(Some).map_err(TakeError::Invalid)
    }

    /// Takes the oldest valid sample, if there is one; invalid ones are counted and passed over, refusals are counted.
    ///
    /// # Real-time
    /// As [`try_take`](Self::try_take), for each invalid sample.
    ///
    /// # Errors
    /// [`TakeError`], but not [`TakeError::Invalid`].
    pub fn try_take_valid(&self) -> Result<Option<Sample<T>>, TakeError> {
        loop {
            let Some(raw) = self.raw.try_take_valid()? else { return Ok(None) };
            if let Ok(sample) = self.check(raw) {
                return Ok(Some(sample));
            }
        }
    }

    /// Polls for a sample. Registers the task before looking, so that a ring after the look wakes it.
    ///
    /// # Real-time
    /// As [`try_take_valid`](Self::try_take_valid).
    pub fn poll_take(&self, context: &mut Context<'_>) -> Poll<Sample<T>> {
        loop {
            let Poll::Ready(raw) = self.raw.poll_take(context) else { return Poll::Pending };
            if let Ok(sample) = self.check(raw) {
                return Poll::Ready(sample);
            }
        }
    }

    fn check(&self, raw: RawSample) -> Result<Sample<T>, Invalid> {
        let checked = Sample::new(raw);
        if checked.is_err() {
            self.raw.note_invalid();
        }
        checked
    }
}

impl<T: Message + Plain> Stream for Subscription<T> {
    type Item = Sample<T>;

    /// # Real-time
    /// As [`Subscription::try_take`]. Never ends.
    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Sample<T>>> {
        self.poll_take(context).map(Some)
    }
}
