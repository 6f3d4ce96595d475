// SPDX-License-Identifier: MIT OR Apache-2.0
//! A request and its response: sending, taking, answering, collecting.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use super::client::{Availability, RawClient, RawPending, Shared, Unsent};
use super::pending::Outcome;
use super::server::{RawResponse, RequestId, Responders};
use super::{RESPONSES_DEPTH, ServiceError};
use crate::header::MessageInfo;
use crate::publisher::{RawLoan, RawPublisher, Unpublished};
use crate::subscription::{Patience, RawSample};
use core::future::Future;
use core::ops::{Deref, DerefMut};
use core::pin::Pin;
use core::task::{Context, Poll};
use tautline_rt::clock::wall_ns;

/// Responses that one collection takes at most: a server that sends without being asked must not keep a thread busy.
const COLLECTED_AT_ONCE: usize = RESPONSES_DEPTH;

/// The time stamp of a response that is none: there is no answer to its request.
const NO_ANSWER_NS: i64 = i64::MIN;

impl RawClient {
    /// Loans memory for a request of `len_bytes`. See [`RawPublisher::loan`].
    ///
    /// # Real-time
    /// As [`RawPublisher::loan`].
    ///
    /// # Errors
    /// [`ServiceError::Loan`].
    pub fn loan(&self, len_bytes: usize) -> Result<RawLoan<'_>, ServiceError> {
        self.publisher().loan(len_bytes).map_err(|source| self.shared.loan_error(source))
    }

    pub(super) fn publisher(&self) -> &RawPublisher {
        self.shared.publisher.get()
    }

    /// Sends a request to every server. The first response counts.
    ///
    /// # Real-time
    /// Wait-free, O(responses x pending requests + servers); no allocation; at most one futex wake per sampler that sleeps, and per
    /// callback thread of a server that sleeps and is woken directly; and one for each task whose response is taken on the way and
    /// whose thread sleeps. When servers have appeared or gone since the last call: allocates and maps memory.
    ///
    /// # Errors
    /// [`Unsent`]: [`ServiceError::NoServer`], [`ServiceError::RequestsFull`], [`ServiceError::TooManyPending`] with the loan.
    pub fn send<'c>(&'c self, request: RawLoan<'c>) -> Result<RawPending, Unsent<RawLoan<'c>>> {
        let shared = &self.shared;
        // What came in makes room for what comes next.
        shared.collect();
        let service = || shared.service.clone();
        let unsent = |error, loan| Err(Unsent { error, loan });
        if shared.table.alive() == 0 {
            return unsent(ServiceError::NoServer { service: service() }, Some(request));
        }
        let Some(place) = shared.table.claim() else {
            return unsent(ServiceError::TooManyPending { service: service() }, Some(request));
        };
        let sequence_number = self.sequence_number.get() + 1;
        self.sequence_number.set(sequence_number);
        shared.table.arm(place, sequence_number);
        // Whoever waits with more requests is woken when there is room: `collect` has registered.
        match request.publish_as_or_ask(stamped(sequence_number, self.gid())) {
            Ok(()) => {}
            Err(Unpublished::Full(loan)) => {
                shared.table.release(place);
                return unsent(ServiceError::RequestsFull { service: service() }, Some(loan));
            }
            Err(Unpublished::Incomplete) => {
                shared.table.release(place);
                return unsent(ServiceError::Incomplete { service: service() }, None);
            }
        }
        shared.table.sent(place);
        Ok(RawPending { shared: shared.clone(), place: Some(place), sequence_number })
    }
}

/// What a request and its response say of themselves.
fn stamped(sequence_number: u64, client: crate::header::Gid) -> MessageInfo {
    MessageInfo { sequence_number, source_timestamp_ns: wall_ns(), released_ns: 0, publisher_gid: client }
}

/// Instead of a response; to no request at all if that is 0.
pub(super) fn no_answer(sequence_number: u64, client: crate::header::Gid) -> MessageInfo {
    MessageInfo { source_timestamp_ns: NO_ANSWER_NS, ..stamped(sequence_number, client) }
}

impl Shared {
    pub(super) fn loan_error(&self, source: crate::error::LoanError) -> ServiceError {
        ServiceError::Loan { service: self.service.clone(), source }
    }

    /// Takes the responses that are there, for whoever waits for them, and notes servers that appeared or went.
    ///
    /// # Real-time
    /// Wait-free, O(responses x pending requests); no allocation; a syscall for each task whose thread sleeps. When servers
    /// have appeared or gone: allocates.
    pub(super) fn collect(&self) {
        let missed = self.inbox.attempt(|inbox| {
            let slot = self.publisher.slot();
            slot.waker().register(&self.waker);
            let epoch = slot.epoch();
            if epoch != inbox.epoch {
                inbox.epoch = epoch;
                // Before the responses: what a server sent before it went is in the queue by then.
                self.list_servers(&mut inbox.servers);
            }
            let mut context = Context::from_waker(&self.waker);
            for _ in 0..COLLECTED_AT_ONCE {
                let mut patience = Patience::new();
                let Poll::Ready(response) = inbox.responses.poll_within(&mut context, &mut patience) else {
                    // Else there may be more, also of servers that went, and the waker is called for it.
                    if !patience.is_over()
                        && let Some((gone, alive)) = inbox.servers.take_change()
                    {
                        self.table.servers_changed(gone, alive);
                    }
                    return;
                };
                let info = response.info();
                let is_none = info.source_timestamp_ns == NO_ANSWER_NS;
                let outcome = if is_none { Outcome::ServerGone } else { Outcome::Response(response) };
                self.table.answer(info.sequence_number, outcome);
            }
            self.waker.wake_by_ref();
        });
        if missed {
            self.table.waiters().wake_all();
        }
    }

    /// The outcome of what waits in `place`, which is then free.
    fn poll_outcome(&self, place: &mut Option<usize>, context: &mut Context<'_>) -> Poll<Outcome> {
        let Some(index) = *place else { return Poll::Pending };
        // Registered before the look: whoever puts something there after it wakes this task.
        self.table.register(index, context.waker());
        self.collect();
        match self.table.take(index) {
            None => Poll::Pending,
            Some(outcome) => {
                *place = None;
                Poll::Ready(outcome)
            }
        }
    }
}

impl RawPending {
    /// The request's number, which its response repeats.
    pub fn sequence_number(&self) -> u64 {
        self.sequence_number
    }
}

impl Future for RawPending {
    type Output = Result<RawSample, ServiceError>;

    /// # Real-time
    /// Wait-free, O(responses x pending requests); no allocation; woken through this process's sampler. Whichever of a client's
    /// requests is polled first takes the responses for all of them: if they wait in threads of several priorities, one may wait for
    /// a thread of a lower one; a client for each thread does not. Once it was ready it is pending for ever.
    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        let RawPending { shared, place, .. } = &mut *self;
        shared.poll_outcome(place, context).map(|outcome| match outcome {
            Outcome::Response(response) => Ok(response),
            Outcome::ServerGone | Outcome::Available => {
                Err(ServiceError::ServerGone { service: shared.service.clone() })
            }
        })
    }
}

impl Drop for RawPending {
    /// # Real-time
    /// Wait-free; no allocation; no syscall, unless the client is gone as well: the last one frees what they share.
    fn drop(&mut self) {
        if let Some(place) = self.place {
            self.shared.table.release(place);
        }
    }
}

impl Future for Availability {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<()> {
        let Availability { shared, place } = &mut *self;
        if place.is_some() {
            shared.collect();
            if shared.table.alive() != 0 {
                return Poll::Ready(());
            }
        }
        shared.poll_outcome(place, context).map(|_| ())
    }
}

impl Drop for Availability {
    fn drop(&mut self) {
        if let Some(place) = self.place {
            self.shared.table.release(place);
        }
    }
}

impl Responders {
    /// The publisher of responses to `client`.
    ///
    /// # Real-time
    /// Wait-free, O(clients); no allocation; no syscall.
    pub(super) fn publisher(&self, client: crate::header::Gid) -> Result<&RawPublisher, ServiceError> {
        let responder = self.list.iter().find(|responder| responder.client == client);
        let missing = || match self.unreachable.contains(&client) {
            true => ServiceError::ClientUnreachable { service: self.service.clone() },
            false => ServiceError::ClientGone { service: self.service.clone() },
        };
        Ok(&responder.ok_or_else(missing)?.publisher)
    }

    /// Loans memory for a response of `len_bytes` to the request `id`.
    ///
    /// # Real-time
    /// As [`RawPublisher::loan`], and O(clients).
    ///
    /// # Errors
    /// [`ServiceError::ClientGone`], [`ServiceError::ClientUnreachable`], [`ServiceError::Loan`].
    pub fn loan(&self, id: RequestId, len_bytes: usize) -> Result<RawResponse<'_>, ServiceError> {
        let loan = self.publisher(id.client)?.loan(len_bytes);
        let loan = loan.map_err(|source| ServiceError::Loan { service: self.service.clone(), source })?;
        Ok(RawResponse { responders: self, loan, id })
    }

    /// Ends the request `id` without an answer: its client gets [`ServiceError::ServerGone`]. For who serves on behalf of others
    /// that have gone.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan) and [`RawResponse::send`].
    ///
    /// # Errors
    /// [`ServiceError::ClientGone`], [`ServiceError::ClientUnreachable`], [`ServiceError::Loan`],
    /// [`ServiceError::ResponsesFull`].
    pub fn refuse(&self, id: RequestId) -> Result<(), ServiceError> {
        let loan = self.loan(id, 0)?.loan;
        Ok(self.publish(loan, no_answer(id.sequence_number, id.client))?)
    }

    /// Sends a response.
    pub(super) fn send<'s>(&self, id: RequestId, loan: RawLoan<'s>) -> Result<(), Unsent<RawLoan<'s>>> {
        self.publish(loan, stamped(id.sequence_number, id.client))
    }

    fn publish<'s>(&self, loan: RawLoan<'s>, info: MessageInfo) -> Result<(), Unsent<RawLoan<'s>>> {
        let service = || self.service.clone();
        loan.publish_as(info).map_err(|unpublished| match unpublished {
            Unpublished::Full(loan) => {
                Unsent { error: ServiceError::ResponsesFull { service: service() }, loan: Some(loan) }
            }
            Unpublished::Incomplete => {
                Unsent { error: ServiceError::Incomplete { service: service() }, loan: None }
            }
        })
    }
}

impl RawResponse<'_> {
    /// Sends the response to the client that asked.
    ///
    /// # Real-time
    /// As [`RawLoan::publish`].
    ///
    /// # Errors
    /// [`Unsent`]: [`ServiceError::ResponsesFull`] with the response.
    #[allow(clippy::result_large_err, reason = "it gives the response back")]
    pub fn send(self) -> Result<(), Unsent<Self>> {
        let RawResponse { responders, loan, id } = self;
        let unsent = responders.send(id, loan);
        unsent.map_err(|unsent| unsent.map(|loan| RawResponse { responders, loan, id }))
    }
}

impl Deref for RawResponse<'_> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.loan
    }
}

impl DerefMut for RawResponse<'_> {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.loan
    }
}
