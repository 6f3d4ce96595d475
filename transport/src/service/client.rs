// SPDX-License-Identifier: MIT OR Apache-2.0
//! Untyped clients: their parts, and how they discover servers. The work for each request is in `hot.rs`.

use crate::error::{SendError, TransportError};
use crate::memory::header::Gid;
use crate::qos::{Limits, Qos};
use crate::service::error::ServiceError;
use crate::service::pending::PendingTable;
use crate::service::service_type::{RESPONSES_DEPTH, ServiceType, response_limits, topics};
use crate::topic::endpoints::EndpointList;
use crate::topic::participant::Participant;
use crate::topic::publisher::RawPublisher;
use crate::topic::reader::core::SubscriptionRole;
use crate::topic::subscription::RawSubscription;
use crate::topic::writer::core::PublisherRole;
use std::cell::Cell;
use std::sync::Arc;
use std::task::Waker;
use tautline_doorbell::Slot;
use tautline_rt::{LatestReader, PiMutex};

/// Sends requests as bytes to a service and gets the responses. The layer above knows the type.
///
/// May be moved between threads, but only one thread uses it at a time. The futures that wait for its responses
/// may be in any thread.
pub struct RawClient {
    pub(super) state: Arc<ClientState>,
    /// The number of the last request.
    pub(super) sequence_number: Cell<u64>,
}

/// The pending response to one request. Dropping it cancels the wait; the server is not notified.
#[must_use = "the response is lost unless it is awaited"]
pub struct RawPending {
    pub(super) state: Arc<ClientState>,
    /// The place in the table, until it is released.
    pub(super) place: Option<usize>,
    pub(super) sequence_number: u64,
}

/// Waits until there is a server.
#[must_use = "nothing is waited for unless it is awaited"]
pub struct Availability {
    pub(super) state: Arc<ClientState>,
    pub(super) place: Option<usize>,
}

impl<L> From<SendError<L, ServiceError>> for ServiceError {
    fn from(unsent: SendError<L, ServiceError>) -> Self {
        unsent.error
    }
}

/// State that a client and its pending requests share. It lives as long as one of them.
pub(super) struct ClientState {
    pub(super) service: Arc<str>,
    pub(super) publisher: OfClient<RawPublisher>,
    /// Threads of several priorities may wait for responses: the thread that holds the lock inherits the highest of them.
    pub(super) inbox: PiMutex<Inbox>,
    pub(super) table: PendingTable,
    /// Wakes every task that waits.
    pub(super) waker: Waker,
}

pub(super) struct Inbox {
    pub(super) responses: RawSubscription,
    pub(super) servers: Servers,
}

/// A part that only the client uses, although pending requests also keep it alive.
pub(super) struct OfClient<T>(T);

// SAFETY: `get` is called through a RawClient, which is not Sync and not Clone: by one thread at a time. Other threads access only
// the slot of an `OfClient<RawPublisher>`, which is Sync. Only the last owner drops it.
unsafe impl<T: Send> Sync for OfClient<T> {}

impl<T> OfClient<T> {
    pub(super) fn get(&self) -> &T {
        &self.0
    }
}

impl OfClient<RawPublisher> {
    /// The slot that is rung when servers appear or disappear.
    pub(super) fn slot(&self) -> &Slot {
        self.0.slot()
    }
}

/// The servers, each with a bit, the least recently used one first.
pub(super) struct Servers {
    /// The servers' endpoints that receive this client's requests.
    asked: LatestReader<Arc<EndpointList>>,
    /// The servers' endpoints whose responses arrive here.
    answering: LatestReader<Arc<EndpointList>>,
    is_first: bool,
    known: Vec<KnownServer>,
    next: u32,
    /// The bits of the servers that have disappeared since the last [`take_change`](Self::take_change), and of those that exist.
    change: Option<(u64, u64)>,
}

/// A server, identified by both of its endpoints.
#[derive(Clone, Copy)]
struct KnownServer {
    asked: Gid,
    answering: Gid,
    bit: u64,
}

impl Servers {
    pub(super) fn new(
        asked: LatestReader<Arc<EndpointList>>,
        answering: LatestReader<Arc<EndpointList>>,
    ) -> Self {
        // Room for as many servers as there are bits.
        let known = Vec::with_capacity(u64::BITS as usize);
        Servers { asked, answering, is_first: true, known, next: 0, change: None }
    }

    /// Updates the known servers.
    ///
    /// # Real-time
    /// Two loads if nothing changed, else O(servers x log servers); no allocation; no syscall.
    pub(super) fn update(&mut self) {
        if !std::mem::take(&mut self.is_first) && !self.asked.is_fresh() && !self.answering.is_fresh() {
            return;
        }
        let (asked, answering) = (self.asked.read(), self.answering.read());
        let is_there = |list: &EndpointList, gid: &Gid| {
            let found = list.endpoints.binary_search_by_key(gid, |endpoint| endpoint.gid).ok();
            found
                .and_then(|place| list.endpoints.get(place))
                .is_some_and(|endpoint| endpoint.mismatch.is_none())
        };
        let mut gone = self.change.map_or(0, |(gone, _)| gone);
        self.known.retain(|known| {
            let stays = is_there(asked, &known.asked) && is_there(answering, &known.answering);
            gone |= if stays { 0 } else { known.bit };
            stays
        });
        let mut alive = self.known.iter().fold(0, |bits, known| bits | known.bit);
        for endpoint in answering.endpoints.iter().filter(|endpoint| endpoint.mismatch.is_none()) {
            let Some(partner) = endpoint.partner else { continue };
            let server = Gid::of(endpoint.gid.participant(), partner);
            // A server that disappeared keeps its bit until `take_change`, after which requests no longer wait for it. Servers beyond
            // the number of bits answer, too, but no request waits for them alone.
            let used = alive | gone;
            let is_known = self.known.iter().any(|known| known.answering == endpoint.gid);
            if !is_known && used != u64::MAX && is_there(asked, &server) {
                while used & (1 << (self.next % u64::BITS)) != 0 {
                    self.next = self.next.wrapping_add(1);
                }
                let bit = 1 << (self.next % u64::BITS);
                self.next = self.next.wrapping_add(1);
                alive |= bit;
                self.known.push(KnownServer { asked: server, answering: endpoint.gid, bit });
            }
        }
        self.change = Some((gone, alive));
    }

    pub(super) fn count(&self) -> usize {
        self.known.len()
    }

    /// The bits of the servers that disappeared since the last call, and of those that exist, if anything changed.
    pub(super) fn take_change(&mut self) -> Option<(u64, u64)> {
        self.change.take()
    }
}

/// The endpoints of a client's two topics, and the servers that they are connected to.
pub(super) struct ClientEndpoints {
    pub(super) publisher: RawPublisher,
    pub(super) responses: RawSubscription,
    pub(super) servers: Servers,
}

impl ClientEndpoints {
    /// Creates the endpoints. Up to `depth` responses of each server are queued.
    pub(super) fn create(
        participant: &Participant,
        service: &str,
        service_type: &ServiceType,
        depth: usize,
        of_responses: Limits,
        of_requests: Limits,
    ) -> Result<Self, TransportError> {
        let [requests, responses] = topics(service)?;
        let number = Some(participant.state.record.number());
        let qos = Qos::keep_all(depth);
        let role = SubscriptionRole { partner: number, ..SubscriptionRole::default() };
        // Created first, so that every server that gets a request can respond.
        let responses = RawSubscription::create(
            participant,
            &responses,
            &service_type.response,
            qos,
            of_responses,
            role,
        )?;
        let (qos, role) = (Qos::keep_all(1), PublisherRole { number, ..PublisherRole::default() });
        let publisher =
            RawPublisher::create(participant, &requests, &service_type.request, qos, of_requests, role)?;
        let servers = Servers::new(publisher.core().monitor(), responses.core().monitor());
        Ok(ClientEndpoints { publisher, responses, servers })
    }
}

impl Participant {
    /// Creates a client of `service`, a fully qualified name. The number of pending requests is limited to
    /// [`MAX_PENDING_REQUESTS`](crate::MAX_PENDING_REQUESTS).
    ///
    /// # Real-time
    /// Setup only. Waits up to 100 ms for the processes of existing servers, because one of them may be
    /// stopped.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid name, a limit out of range.
    pub fn create_raw_client(
        &self,
        service: &str,
        service_type: &ServiceType,
        limits: Limits,
    ) -> Result<RawClient, TransportError> {
        let ClientEndpoints { publisher, responses, servers } = ClientEndpoints::create(
            self,
            service,
            service_type,
            RESPONSES_DEPTH,
            response_limits(limits),
            limits,
        )?;
        let table = PendingTable::new();
        let waker = Waker::from(table.waiters().clone());
        let state = ClientState {
            service: service.into(),
            publisher: OfClient(publisher),
            inbox: PiMutex::new(Inbox { responses, servers }),
            table,
            waker,
        };
        let client = RawClient { state: Arc::new(state), sequence_number: Cell::new(0) };
        client.state.collect();
        Ok(client)
    }
}

impl RawClient {
    /// The service's fully qualified name.
    pub fn service(&self) -> &str {
        &self.state.service
    }

    /// This client's identifier: the GID of its publisher of requests.
    pub fn gid(&self) -> Gid {
        self.state.publisher.get().gid()
    }

    /// Number of servers, 64 at most.
    pub fn server_count(&self) -> usize {
        self.state.collect();
        self.state.table.alive().count_ones() as usize
    }

    /// Waits until there is a server. Counts as a pending request.
    ///
    /// # Errors
    /// [`ServiceError::TooManyPending`].
    pub fn availability(&self) -> Result<Availability, ServiceError> {
        let place = self.state.table.claim();
        let place =
            place.ok_or_else(|| ServiceError::TooManyPending { service: self.state.service.clone() })?;
        self.state.table.arm(place, 0);
        Ok(Availability { state: self.state.clone(), place: Some(place) })
    }
}

tautline_rt::debug_fields!(RawClient, |this| service = this.service(), gid = this.gid());

tautline_rt::debug_fields!(
    RawPending,
    |this| service = this.state.service,
    sequence_number = this.sequence_number
);

tautline_rt::debug_fields!(Availability, |this| service = this.state.service);
