// SPDX-License-Identifier: MIT OR Apache-2.0
//! A request and its response: sending, taking, responding, collecting.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::error::{LoanError, PublishError, SendError, TakeError};
use crate::memory::header::{Gid, MessageInfo, SampleKind};
use crate::service::client::{Availability, ClientState, Inbox, RawClient, RawPending};
use crate::service::error::ServiceError;
use crate::service::pending::Outcome;
use crate::service::server::{RawResponse, RawServer, RequestId};
use crate::service::service_type::RESPONSES_DEPTH;
use crate::topic::publisher::RawPublisher;
use crate::topic::publisher::hot::{RawLoan, Sending, Stamp, WhenFull};
use crate::topic::subscription::hot::{PollBudget, RawSample};
use core::future::Future;
use core::ops::{Deref, DerefMut};
use core::pin::Pin;
use core::task::{Context, Poll};
use tautline_rt::clock::wall_ns;

/// Maximum of responses that one collection takes: a server that sends unrequested responses must not keep a thread busy.
const COLLECTED_AT_ONCE: usize = RESPONSES_DEPTH;

impl RawClient {
    /// Loans memory for a request of `len_bytes`. See [`RawPublisher::loan`].
    ///
    /// # Real-time
    /// As [`RawPublisher::loan`].
    ///
    /// # Errors
    /// [`ServiceError::Loan`].
    pub fn loan(&self, len_bytes: usize) -> Result<RawLoan<'_>, ServiceError> {
        self.publisher().loan(len_bytes).map_err(|source| self.state.loan_error(source))
    }

    pub(super) fn publisher(&self) -> &RawPublisher {
        self.state.publisher.get()
    }

    /// Sends a request to every server. The first response counts.
    ///
    /// # Real-time
    /// Wait-free, O(responses x pending requests + servers); no allocation; at most one futex wake per sampler that sleeps, and per
    /// callback thread of a server that sleeps and is woken directly; and one for each task whose response is taken meanwhile and
    /// whose thread sleeps. Waits for a thread that is taking responses at that moment, which inherits this thread's priority
    /// meanwhile.
    ///
    /// # Errors
    /// [`SendError`], with the loan: [`ServiceError::NoServer`], [`ServiceError::RequestsFull`], [`ServiceError::TooManyPending`],
    /// [`ServiceError::Loan`].
    pub fn send<'c>(
        &'c self,
        request: RawLoan<'c>,
    ) -> Result<RawPending, SendError<RawLoan<'c>, ServiceError>> {
        let state = &self.state;
        // Taking the responses that have arrived makes room for further ones.
        state.collect();
        let service = || state.service.clone();
        let unsent = |error, loan| Err(SendError { error, loan });
        if state.table.alive() == 0 {
            return unsent(ServiceError::NoServer { service: service() }, request);
        }
        let Some(place) = state.table.claim() else {
            return unsent(ServiceError::TooManyPending { service: service() }, request);
        };
        let sequence_number = self.sequence_number.get() + 1;
        self.sequence_number.set(sequence_number);
        state.table.arm(place, sequence_number);
        // Tasks that wait with further requests are woken when there is room: `collect` has registered the waker.
        let stamp = Stamp::OfRequest(stamped(sequence_number, self.gid()));
        let sending = Sending { stamp, when_full: WhenFull::Ask, kind: SampleKind::Message, to: None };
        if let Err(unpublished) = request.publish_with(sending) {
            state.table.release(place);
            let error = match unpublished.error {
                PublishError::Full => ServiceError::RequestsFull { service: service() },
                _ => state.loan_error(LoanError::OutOfMemory),
            };
            return unsent(error, unpublished.loan);
        }
        state.table.sent(place);
        Ok(RawPending { state: state.clone(), place: Some(place), sequence_number })
    }
}

/// The message info of a request and of its response.
pub(super) fn stamped(sequence_number: u64, client: Gid) -> MessageInfo {
    MessageInfo { sequence_number, source_timestamp_ns: wall_ns(), released_ns: 0, publisher_gid: client }
}

impl ClientState {
    pub(super) fn loan_error(&self, source: LoanError) -> ServiceError {
        ServiceError::Loan { service: self.service.clone(), source }
    }

    /// Takes the responses that have arrived, for the tasks that wait for them, and notes servers that appeared or disappeared.
    ///
    /// # Real-time
    /// O(responses x pending requests), and O(servers) when they have appeared or gone; no allocation; a syscall for each task whose
    /// thread sleeps. A thread that does this right now is waited for, and has this one's priority meanwhile.
    pub(super) fn collect(&self) {
        let mut inbox = self.inbox.lock();
        let Inbox { responses, servers } = &mut *inbox;
        self.publisher.slot().waker().register(&self.waker);
        // Before the responses: those that a server sent before it disappeared are in the queue by then.
        servers.update();
        let mut context = Context::from_waker(&self.waker);
        for _ in 0..COLLECTED_AT_ONCE {
            let mut budget = PollBudget::new();
            let Poll::Ready(Some(response)) = responses.poll_within(&mut context, &mut budget) else {
                // With a spent budget there may be more responses, also of servers that disappeared, and the waker is called for them. The
                // budget is also spent while as many responses are held as can be: then none can be taken if the queue has none.
                if (!budget.is_spent() || !responses.has_samples())
                    && let Some((gone, alive)) = servers.take_change()
                {
                    self.table.servers_changed(gone, alive);
                }
                if responses.has_ended() {
                    // The client's node has ended.
                    self.table.end();
                }
                return;
            };
            let number = response.info().sequence_number;
            let outcome = match response.kind() {
                SampleKind::Message => Outcome::Response(response),
                SampleKind::NoAnswer => Outcome::ServerGone,
            };
            self.table.answer(number, outcome);
        }
        self.waker.wake_by_ref();
    }

    /// Polls for the outcome of the request or wait in `place`. Frees the place when it returns the outcome.
    fn poll_outcome(&self, place: &mut Option<usize>, context: &mut Context<'_>) -> Poll<Outcome> {
        let Some(index) = *place else { return Poll::Pending };
        // Registered before the check: a thread that stores an outcome after it wakes this task.
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
    /// O(responses x pending requests); no allocation; woken through this process's sampler. Whichever of a client's requests is polled
    /// first takes the responses for all of them; another thread that polls meanwhile waits for that and lends it its priority. Once it
    /// was ready it is pending for ever.
    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        let RawPending { state, place, .. } = &mut *self;
        state.poll_outcome(place, context).map(|outcome| match outcome {
            Outcome::Response(response) => Ok(response),
            Outcome::ServerGone | Outcome::Available => {
                Err(ServiceError::ServerGone { service: state.service.clone() })
            }
        })
    }
}

impl Drop for RawPending {
    /// # Real-time
    /// Wait-free; no allocation; no syscall, unless the client is gone as well: the last one frees what they share.
    fn drop(&mut self) {
        if let Some(place) = self.place {
            self.state.table.release(place);
        }
    }
}

impl Future for Availability {
    type Output = Result<(), ServiceError>;

    /// # Errors
    /// [`ServiceError::Loan`]: the client's node has ended.
    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        let Availability { state, place } = &mut *self;
        if place.is_some() {
            state.collect();
            if state.table.alive() != 0 {
                return Poll::Ready(Ok(()));
            }
        }
        state.poll_outcome(place, context).map(|outcome| match outcome {
            Outcome::Available | Outcome::Response(_) => Ok(()),
            Outcome::ServerGone => Err(state.loan_error(LoanError::Ended)),
        })
    }
}

impl Drop for Availability {
    fn drop(&mut self) {
        if let Some(place) = self.place {
            self.state.table.release(place);
        }
    }
}

impl RawServer {
    /// Takes the oldest request, if there is one.
    ///
    /// # Real-time
    /// As [`RawSubscription::try_take_valid`](crate::RawSubscription::try_take_valid).
    pub fn try_take(&self) -> Result<Option<RawSample>, TakeError> {
        self.requests.try_take_valid()
    }

    /// Polls for a request.
    ///
    /// # Real-time
    /// As [`try_take`](Self::try_take).
    pub fn poll_take(&self, context: &mut Context<'_>) -> Poll<Option<RawSample>> {
        self.requests.poll_take(context)
    }

    /// Whether a response can be sent to this client now.
    ///
    /// # Real-time
    /// Wait-free, O(clients); no allocation; no syscall.
    pub fn can_answer(&self, client: Gid) -> bool {
        self.responses.subscription_of(client).is_some()
    }

    /// The client's subscription to responses.
    pub(super) fn subscription_of(&self, client: Gid) -> Result<Gid, ServiceError> {
        let is_there = || self.requests.has_publisher(client) && self.requests.has_participant_of(client);
        self.responses.subscription_of(client).ok_or_else(|| match is_there() {
            true => ServiceError::ClientUnreachable { service: self.service.clone() },
            false => ServiceError::ClientGone { service: self.service.clone() },
        })
    }

    pub(super) fn loan_error(&self, source: LoanError) -> ServiceError {
        ServiceError::Loan { service: self.service.clone(), source }
    }

    /// Loans memory for a response of `len_bytes` to the request `id`.
    ///
    /// # Real-time
    /// As [`RawPublisher::loan`], and O(clients). A server has memory for 16 responses more than `Limits::loans`; if clients leave more
    /// responses untaken, the server needs more memory: allocates, maps memory.
    ///
    /// # Errors
    /// [`ServiceError::ClientGone`], [`ServiceError::ClientUnreachable`], [`ServiceError::Loan`].
    pub fn loan(&self, id: RequestId, len_bytes: usize) -> Result<RawResponse<'_>, ServiceError> {
        self.subscription_of(id.client)?;
        let loan = self.responses.loan(len_bytes).map_err(|source| self.loan_error(source))?;
        Ok(RawResponse { server: self, loan, id })
    }

    /// Ends the request `id` without a response: its client gets [`ServiceError::ServerGone`]. For relays that serve on behalf
    /// of servers that have ended.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan) and [`RawResponse::send`].
    ///
    /// # Errors
    /// [`ServiceError::ClientGone`], [`ServiceError::ClientUnreachable`], [`ServiceError::Loan`],
    /// [`ServiceError::ResponsesFull`].
    pub fn refuse(&self, id: RequestId) -> Result<(), ServiceError> {
        let loan = self.loan(id, 0)?.loan;
        Ok(self.publish(id, loan, SampleKind::NoAnswer)?)
    }

    pub(super) fn send<'s>(
        &'s self,
        id: RequestId,
        loan: RawLoan<'s>,
    ) -> Result<(), SendError<RawLoan<'s>, ServiceError>> {
        self.publish(id, loan, SampleKind::Message)
    }

    fn publish<'s>(
        &'s self,
        id: RequestId,
        loan: RawLoan<'s>,
        kind: SampleKind,
    ) -> Result<(), SendError<RawLoan<'s>, ServiceError>> {
        let to = match self.subscription_of(id.client) {
            Ok(to) => Some(to),
            Err(error) => return Err(SendError { error, loan }),
        };
        let stamp = Stamp::OfRequest(stamped(id.sequence_number, id.client));
        let sent = loan.publish_with(Sending { stamp, when_full: WhenFull::Leave, kind, to });
        sent.map_err(|unpublished| {
            let error = match unpublished.error {
                PublishError::Full => ServiceError::ResponsesFull { service: self.service.clone() },
                _ => self.loan_error(LoanError::OutOfMemory),
            };
            SendError { error, loan: unpublished.loan }
        })
    }
}

impl RawResponse<'_> {
    /// As [`RawLoan::truncate`].
    ///
    /// # Real-time
    /// As [`RawLoan::truncate`].
    pub fn truncate(&mut self, len_bytes: usize) {
        self.loan.truncate(len_bytes);
    }

    /// Sends the response to the requesting client.
    ///
    /// # Real-time
    /// As [`RawLoan::publish`], and O(clients).
    ///
    /// # Errors
    /// [`SendError`], with the response: [`ServiceError::ClientGone`], [`ServiceError::ClientUnreachable`],
    /// [`ServiceError::ResponsesFull`], [`ServiceError::Loan`].
    #[allow(clippy::result_large_err, reason = "it gives the response back")]
    pub fn send(self) -> Result<(), SendError<Self, ServiceError>> {
        let RawResponse { server, loan, id } = self;
        let unsent = server.send(id, loan);
        unsent.map_err(|unsent| unsent.map(|loan| RawResponse { server, loan, id }))
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
