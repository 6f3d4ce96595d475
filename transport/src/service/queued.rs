// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clients that take responses in the order of arrival, for callers that keep track of their requests themselves.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::error::{LoanError, PublishError, SendError, TakeError, TransportError};
use crate::memory::header::{Gid, SampleKind};
use crate::qos::Limits;
use crate::service::client::{ClientEndpoints, Servers};
use crate::service::error::ServiceError;
use crate::service::hot::stamped;
use crate::service::service_type::ServiceType;
use crate::topic::participant::Participant;
use crate::topic::publisher::RawPublisher;
use crate::topic::publisher::hot::{RawLoan, Sending, Stamp, WhenFull};
use crate::topic::subscription::RawSubscription;
use crate::topic::subscription::hot::{PollBudget, RawSample};
use core::cell::{Cell, RefCell};
use core::task::Waker;
use std::sync::Arc;
use tautline_doorbell::Slot;

/// Sends requests as bytes to a service and takes all responses in the order of arrival: each server's response to each request.
/// Any number of requests may be pending.
///
/// May be moved between threads, but only one thread uses it at a time.
pub struct QueuedClient {
    service: Arc<str>,
    publisher: RawPublisher,
    responses: RawSubscription,
    servers: RefCell<Servers>,
    /// Rung when servers appear or disappear.
    changes: Slot,
    /// The number of the last request.
    sequence_number: Cell<u64>,
}

impl Participant {
    /// Creates a client of `service`, a fully qualified name. Up to `depth` responses of each server are queued here; a server that
    /// sends more gets [`ServiceError::ResponsesFull`].
    ///
    /// # Real-time
    /// Setup only. Waits up to 100 ms for the processes of existing servers, because one of them may be
    /// stopped.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid name, a limit out of range.
    pub fn create_queued_client(
        &self,
        service: &str,
        service_type: &ServiceType,
        depth: usize,
        limits: Limits,
    ) -> Result<QueuedClient, TransportError> {
        let ClientEndpoints { publisher, responses, servers } =
            ClientEndpoints::create(self, service, service_type, depth, limits, limits)?;
        let changes = self.claim_slot()?;
        for slot in [publisher.slot(), &responses.core().slot] {
            changes.doorbell().arena().set_events(slot.index(), changes.index());
        }
        Ok(QueuedClient {
            service: service.into(),
            publisher,
            responses,
            servers: RefCell::new(servers),
            changes,
            sequence_number: Cell::new(0),
        })
    }
}

impl QueuedClient {
    /// The service's fully qualified name.
    pub fn service(&self) -> &str {
        &self.service
    }

    /// This client's identifier: the GID of its publisher of requests.
    pub fn gid(&self) -> Gid {
        self.publisher.gid()
    }

    /// The subscription to the responses.
    pub fn responses(&self) -> &RawSubscription {
        &self.responses
    }

    /// Number of servers, 64 at most: those that receive this client's requests and whose responses it receives.
    ///
    /// # Real-time
    /// Two loads if nothing changed, else O(servers x log servers); no allocation; no syscall.
    pub fn server_count(&self) -> usize {
        let mut servers = self.servers.borrow_mut();
        servers.update();
        let _ = servers.take_change();
        servers.count()
    }

    /// Registers a waker that is woken, once, when servers appear or disappear, or have room for requests again.
    /// Check for servers and room after this call.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn wake_once(&self, waker: &Waker) {
        self.changes.waker().register(waker);
        self.publisher.slot().waker().register(waker);
    }

    /// Loans memory for a request of `len_bytes`. See [`RawPublisher::loan`].
    ///
    /// # Real-time
    /// As [`RawPublisher::loan`].
    ///
    /// # Errors
    /// [`ServiceError::Loan`].
    pub fn loan(&self, len_bytes: usize) -> Result<RawLoan<'_>, ServiceError> {
        self.publisher.loan(len_bytes).map_err(|source| self.loan_error(source))
    }

    /// Reserves the number of a new request, counted from 1, for a [`send`](Self::send) now or later.
    pub fn reserve(&self) -> u64 {
        let number = self.sequence_number.get() + 1;
        self.sequence_number.set(number);
        number
    }

    /// Sends a request to every server, under a number from [`reserve`](Self::reserve), which its responses repeat.
    ///
    /// # Real-time
    /// As [`RawPublisher::loan`], O(servers); no allocation; at most one futex wake per sampler that sleeps, and per callback thread of
    /// a server that sleeps and is woken directly.
    ///
    /// # Errors
    /// [`SendError`], with the loan: [`ServiceError::NoServer`], [`ServiceError::RequestsFull`], [`ServiceError::Loan`].
    pub fn send<'c>(
        &'c self,
        number: u64,
        request: RawLoan<'c>,
    ) -> Result<(), SendError<RawLoan<'c>, ServiceError>> {
        if self.server_count() == 0 {
            let error = ServiceError::NoServer { service: self.service.clone() };
            return Err(SendError { error, loan: request });
        }
        let stamp = Stamp::OfRequest(stamped(number, self.gid()));
        let sending = Sending { stamp, when_full: WhenFull::Ask, kind: SampleKind::Message, to: None };
        request.publish_with(sending).map_err(|unpublished| {
            let error = match unpublished.error {
                PublishError::Full => ServiceError::RequestsFull { service: self.service.clone() },
                _ => self.loan_error(LoanError::OutOfMemory),
            };
            SendError { error, loan: unpublished.loan }
        })
    }

    /// Takes the oldest response of a server, if there is one. Its message information has the number of its request. Notices that a
    /// request gets no response are skipped.
    ///
    /// # Real-time
    /// As [`RawSubscription::try_take_valid`](crate::RawSubscription::try_take_valid): at most 16 samples of all kinds
    /// are skipped.
    pub fn try_take(&self) -> Result<Option<RawSample>, TakeError> {
        let mut budget = PollBudget::new();
        loop {
            match self.responses.take_valid(&mut budget)? {
                Some(response) if response.kind() != SampleKind::Message => {}
                taken => {
                    if taken.is_none() {
                        self.responses.ring_if_spent(&budget);
                    }
                    return Ok(taken);
                }
            }
        }
    }

    fn loan_error(&self, source: LoanError) -> ServiceError {
        ServiceError::Loan { service: self.service.clone(), source }
    }
}

tautline_rt::debug_fields!(QueuedClient, |this| service = this.service(), gid = this.gid());
