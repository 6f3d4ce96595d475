// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clients of bytes: what they consist of, and how they learn of servers. What is done for each request is in `hot.rs`.

use super::pending::{Table, Turn};
use super::{RESPONSES_DEPTH, ServiceError, ServiceType, request_topic, response_limits, response_topic};
use crate::doorbell::Slot;
use crate::error::TransportError;
use crate::header::Gid;
use crate::nodes::{ServiceKind, ServiceRegistration};
use crate::participant::Participant;
use crate::ports;
use crate::publisher::RawPublisher;
use crate::qos::{Limits, Qos};
use crate::subscription::RawSubscription;
use std::cell::Cell;
use std::fmt;
use std::sync::Arc;
use std::task::Waker;

/// Sends requests of bytes to a service and gets the responses. What is above knows the type.
///
/// May be moved to another thread, and is used by one at a time; what waits for its answers may be in any thread.
pub struct RawClient {
    pub(super) shared: Arc<Shared>,
    /// Of the last request.
    pub(super) sequence_number: Cell<u64>,
}

/// The response to one request, once it is there. Dropping it cancels the wait; the server is not told.
#[must_use = "the response is lost unless it is awaited"]
pub struct RawPending {
    pub(super) shared: Arc<Shared>,
    /// The place in the table, until that is given back.
    pub(super) place: Option<usize>,
    pub(super) sequence_number: u64,
}

/// Waits until there is a server.
#[must_use = "nothing is waited for unless it is awaited"]
pub struct Availability {
    pub(super) shared: Arc<Shared>,
    pub(super) place: Option<usize>,
}

/// A request that was not sent.
pub struct Unsent<L> {
    /// Why.
    pub error: ServiceError,
    /// The loan, untouched, unless it was spent on the attempt.
    pub loan: Option<L>,
}

impl<L> Unsent<L> {
    pub(crate) fn map<M>(self, change: impl FnOnce(L) -> M) -> Unsent<M> {
        Unsent { error: self.error, loan: self.loan.map(change) }
    }
}

impl<L> fmt::Debug for Unsent<L> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Unsent").field("error", &self.error).finish_non_exhaustive()
    }
}

impl<L> fmt::Display for Unsent<L> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.error.fmt(f)
    }
}

impl<L> std::error::Error for Unsent<L> {}

impl<L> From<Unsent<L>> for ServiceError {
    fn from(unsent: Unsent<L>) -> Self {
        unsent.error
    }
}

/// What a client and its pending requests share; it lives as long as one of them.
pub(super) struct Shared {
    pub(super) service: Arc<str>,
    pub(super) publisher: OfClient<RawPublisher>,
    pub(super) inbox: Turn<Inbox>,
    pub(super) table: Table,
    /// Wakes every task that waits.
    pub(super) waker: Waker,
    _registration: Option<ServiceRegistration>,
}

/// What comes in.
pub(super) struct Inbox {
    pub(super) responses: RawSubscription,
    /// The epoch of the request topic's ports that `servers` shows.
    pub(super) epoch: u32,
    pub(super) servers: Servers,
}

/// A part that only the client uses, though its pending requests keep it alive.
pub(super) struct OfClient<T>(T);

// SAFETY: `get` is called through a RawClient, which is not Sync and not Clone: by one thread at a time. `OfClient<RawPublisher>`
// gives others its slot only, which is Sync. Dropping it is the last owner's.
unsafe impl<T: Send> Sync for OfClient<T> {}

impl<T> OfClient<T> {
    pub(super) fn get(&self) -> &T {
        &self.0
    }
}

impl OfClient<RawPublisher> {
    /// Rung when servers appear or go; its epoch then moves.
    pub(super) fn slot(&self) -> &Slot {
        self.0.slot()
    }
}

/// Gives each server a bit, the least recently used one first.
#[derive(Default)]
pub(super) struct Servers {
    known: Vec<(u128, u64)>,
    next: u32,
    /// Those that went and those that are there, since that was last asked for.
    change: Option<(u64, u64)>,
}

impl Servers {
    /// Notes which servers there are.
    fn update(&mut self, ids: &[u128]) {
        let mut gone = self.change.map_or(0, |(gone, _)| gone);
        self.known.retain(|(id, bit)| {
            let stays = ids.contains(id);
            gone |= if stays { 0 } else { *bit };
            stays
        });
        let mut alive = self.known.iter().fold(0, |bits, (_, bit)| bits | bit);
        for id in ids {
            // One that went a moment ago keeps its bit until requests have lost it.
            let used = alive | gone;
            if !self.known.iter().any(|(known, _)| known == id) && used != u64::MAX {
                while used & (1 << (self.next % u64::BITS)) != 0 {
                    self.next = self.next.wrapping_add(1);
                }
                let bit = 1 << (self.next % u64::BITS);
                self.next = self.next.wrapping_add(1);
                alive |= bit;
                self.known.push((*id, bit));
            }
        }
        self.change = Some((gone, alive));
    }

    /// The bits of the servers that went, and of all that are there, if that changed.
    pub(super) fn take_change(&mut self) -> Option<(u64, u64)> {
        self.change.take()
    }
}

impl Shared {
    /// Lists the servers. Only when ports appeared or went: allocates.
    #[cold]
    pub(super) fn list_servers(&self, servers: &mut Servers) {
        let ports = ports::subscriptions(self.publisher.0.factory());
        let ids: Vec<u128> = ports.iter().map(|port| port.id).collect();
        servers.update(&ids);
    }
}

impl Participant {
    /// Creates a client of `service`, a fully qualified name. Of `qos` the depth counts, for servers; what waits for an answer
    /// is limited to [`MAX_PENDING_REQUESTS`](super::MAX_PENDING_REQUESTS).
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: another type, a limit.
    pub fn create_raw_client(
        &self,
        service: &str,
        service_type: &ServiceType,
        limits: Limits,
    ) -> Result<RawClient, TransportError> {
        let topic = request_topic(service);
        let publisher = self.create_raw_publisher(&topic, &service_type.request, Qos::keep_all(1), limits)?;
        // As many servers as the service has by whoever opened it first.
        let limits = Limits { subscribers: publisher.limits().subscribers, ..limits };
        let responses = self.create_raw_subscription(
            &response_topic(publisher.gid()),
            &service_type.response,
            Qos::keep_all(RESPONSES_DEPTH),
            response_limits(limits),
        )?;
        // Servers can greet it now.
        publisher.announce();
        let table = Table::new();
        let waker = Waker::from(table.waiters().clone());
        let epoch = publisher.slot().epoch().wrapping_sub(1);
        let shared = Shared {
            service: service.into(),
            publisher: OfClient(publisher),
            inbox: Turn::new(Inbox { responses, epoch, servers: Servers::default() }),
            table,
            waker,
            _registration: self.register(ServiceKind::Client, service, service_type)?,
        };
        let client = RawClient { shared: Arc::new(shared), sequence_number: Cell::new(0) };
        client.shared.collect();
        Ok(client)
    }
}

impl RawClient {
    /// The service's fully qualified name.
    pub fn service(&self) -> &str {
        &self.shared.service
    }

    /// This client's identifier: that of its requests' publisher.
    pub fn gid(&self) -> Gid {
        self.shared.publisher.get().gid()
    }

    /// Number of servers.
    pub fn server_count(&self) -> usize {
        self.shared.collect();
        self.shared.table.alive().count_ones() as usize
    }

    /// Waits until there is a server. Counts as a pending request.
    ///
    /// # Errors
    /// [`ServiceError::TooManyPending`].
    pub fn availability(&self) -> Result<Availability, ServiceError> {
        let place = self.shared.table.claim();
        let place =
            place.ok_or_else(|| ServiceError::TooManyPending { service: self.shared.service.clone() })?;
        self.shared.table.arm(place, 0);
        Ok(Availability { shared: self.shared.clone(), place: Some(place) })
    }
}

impl fmt::Debug for RawClient {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RawClient")
            .field("service", &self.service())
            .field("gid", &self.gid())
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for RawPending {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RawPending")
            .field("service", &self.shared.service)
            .field("sequence_number", &self.sequence_number)
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Availability {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Availability").field("service", &self.shared.service).finish_non_exhaustive()
    }
}
