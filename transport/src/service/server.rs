// SPDX-License-Identifier: MIT OR Apache-2.0
//! Untyped servers. The work for each request is in `hot.rs`.

use crate::error::TransportError;
use crate::memory::header::{Gid, MessageInfo};
use crate::qos::{Limits, Qos};
use crate::service::service_type::{ServiceType, topics};
use crate::topic::participant::Participant;
use crate::topic::publisher::RawPublisher;
use crate::topic::publisher::hot::RawLoan;
use crate::topic::reader::core::SubscriptionRole;
use crate::topic::subscription::RawSubscription;
use crate::topic::writer::core::PublisherRole;
use std::sync::Arc;

/// Identifies a request of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct RequestId {
    /// The client.
    pub client: Gid,
    /// The request's number, counted by the client from 1.
    pub sequence_number: u64,
}

impl RequestId {
    /// The id of the request whose message information is `info`.
    pub fn of(info: MessageInfo) -> Self {
        RequestId { client: info.publisher_gid, sequence_number: info.sequence_number }
    }
}

/// Takes requests as bytes and responds to them. The layer above knows the type.
///
/// May be moved between threads, but only one thread uses it at a time.
pub struct RawServer {
    pub(super) service: Arc<str>,
    pub(super) requests: RawSubscription,
    /// Sends each response to the subscription of one client.
    pub(super) responses: RawPublisher,
}

/// Memory for a response. Dropping it returns the memory without sending.
#[must_use = "the client gets no response until send() is called"]
pub struct RawResponse<'s> {
    pub(super) server: &'s RawServer,
    pub(super) loan: RawLoan<'s>,
    pub(super) id: RequestId,
}

impl Participant {
    /// Creates a server of `service`, a fully qualified name. `depth` is the number of requests of one client that can
    /// be queued here.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid name, a limit out of range.
    pub fn create_raw_server(
        &self,
        service: &str,
        service_type: &ServiceType,
        depth: usize,
        limits: Limits,
    ) -> Result<RawServer, TransportError> {
        let [requests, responses] = topics(service)?;
        let (qos, role) = (Qos::keep_all(depth), SubscriptionRole::default());
        let requests = RawSubscription::create(self, &requests, &service_type.request, qos, limits, role)?;
        // Clients count a server once it is connected to them for responses: `partner` identifies its subscription to requests.
        let role = PublisherRole {
            is_addressed: true,
            partner: Some(requests.gid().number()),
            ..PublisherRole::default()
        };
        let qos = Qos::keep_all(1);
        let responses = RawPublisher::create(self, &responses, &service_type.response, qos, limits, role)?;
        Ok(RawServer { service: service.into(), requests, responses })
    }
}

impl RawServer {
    /// The service's fully qualified name.
    pub fn service(&self) -> &str {
        &self.service
    }

    /// The subscription to the requests.
    pub fn requests(&self) -> &RawSubscription {
        &self.requests
    }

    /// Number of clients on this host that this server serves.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn client_count(&self) -> usize {
        self.responses.subscription_count()
    }
}

tautline_rt::debug_fields!(RawServer, |this| service = this.service(), clients = this.client_count());

tautline_rt::debug_fields!(RawResponse<'_>, |this| id = this.id);
