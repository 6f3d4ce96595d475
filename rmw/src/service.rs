// SPDX-License-Identifier: MIT OR Apache-2.0
//! Servers of services.

use crate::bindings::*;
use crate::end::{MessageQueue, ReceivingEndpoint};
use crate::error::{Error, Result};
use crate::handle::{endpoint_name, exported, handle};
use crate::node::NodeOfEndpoint;
use crate::on_new::Listeners;
use crate::qos::{self, EndpointRole};
use crate::types::ServiceSupport;
use std::ffi::{c_char, c_void};
use std::sync::Arc;
use tautline_transport::{
    Gid, History, MessageInfo, Qos, RawSample, RawServer, RawSubscription, RequestId, ServiceError, TakeError,
};

pub(crate) struct Service {
    node: NodeOfEndpoint,
    of: ServiceSupport,
    qos: rmw_qos_profile_t,
    depth: Depth,
    /// Clients of this context whose callbacks are called after a response.
    listeners: Arc<Listeners>,
    end: Arc<ReceivingEndpoint<RawServer>>,
}

handle!(rmw_service_t, Service, "the service");

impl MessageQueue for RawServer {
    const IS_TOPIC: bool = false;

    fn subscription(&self) -> &RawSubscription {
        self.requests()
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.end.close();
    }
}

impl Service {
    /// The endpoint, whose requests wake wait sets.
    pub(crate) fn end(&self) -> &ReceivingEndpoint<RawServer> {
        &self.end
    }

    /// Tells the client that there is no response. Clients of rmw_tautline ignore this.
    fn refuse(&self, raw: &RawServer, request: &RawSample, reason: &str) {
        let refused = raw.refuse(RequestId::of(request.info()));
        let failure = refused.map_or_else(|error| format!("; {error}"), |()| String::new());
        tracing::warn!("a request to service '{}' was refused: {reason}{failure}", raw.service());
    }
}

/// Queue limits for requests or responses that arrive faster than they are taken.
#[derive(Clone, Copy)]
pub(crate) struct Depth {
    /// Queue depth, per client or server.
    pub(crate) room: usize,
    /// Maximum of messages that are kept in total at a take, if the profile limits it.
    kept: u64,
}

impl Depth {
    /// Room for a burst; costs nothing until used.
    pub(crate) const ROOM: usize = 1_000;
    /// The default depth of services and clients: as a limit over all clients it would lose requests.
    const DEFAULT: usize = 10;

    /// The QoS and limits of a service or client. A depth below the default is a limit; otherwise it is a minimum.
    pub(crate) fn of(profile: &rmw_qos_profile_t) -> Result<(Qos, Self)> {
        let qos = qos::from_ros(profile, EndpointRole::Service, std::iter::empty())?;
        let is_limit = (1..Self::DEFAULT).contains(&profile.depth) && qos.history == History::KeepLast;
        let kept = if is_limit { qos.depth as u64 } else { u64::MAX };
        let room = qos.depth.max(Self::ROOM);
        Ok((qos, Depth { room, kept }))
    }

    /// Takes the oldest kept message. `lose` gets the messages before it.
    ///
    /// # Real-time
    /// Like `take`, and O(clients or servers), at most once per waiting message.
    pub(crate) fn take(
        self,
        queue: &RawSubscription,
        take: impl Fn() -> std::result::Result<Option<RawSample>, TakeError>,
        lose: impl Fn(RawSample),
    ) -> std::result::Result<Option<RawSample>, TakeError> {
        let take = || {
            if self.kept < u64::MAX {
                // Those of several clients or servers come in turns, not in the order of their times.
                queue.turn_to_oldest();
            }
            take()
        };
        let mut oldest = take()?;
        for _ in self.kept..queue.waiting().saturating_add(1) {
            if queue.waiting() < self.kept {
                break;
            }
            let Ok(Some(next)) = take() else { break };
            oldest.replace(next).into_iter().for_each(&lose);
        }
        Ok(oldest)
    }
}

/// Identifies a request or response.
pub(crate) fn info_of(info: &MessageInfo, received_ns: i64) -> rmw_service_info_t {
    rmw_service_info_t {
        source_timestamp: info.source_timestamp_ns,
        received_timestamp: received_ns,
        request_id: rmw_request_id_t {
            // Signed in some distributions.
            writer_guid: info.publisher_gid.0.map(|byte| byte as _),
            sequence_number: i64::try_from(info.sequence_number).unwrap_or(i64::MAX),
        },
    }
}

exported! {
    fn rmw_create_service(
        node: *const rmw_node_t => behind,
        support: *const rosidl_service_type_support_t,
        name: *const c_char,
        profile: *const rmw_qos_profile_t => given "the QoS profile",
    ) -> *mut rmw_service_t {
        // SAFETY: rmw's contract.
        let (of, name) =
            unsafe { (ServiceSupport::of(support)?, endpoint_name(name, "the service's name", profile)?) };
        let (wanted, depth) = Depth::of(profile)?;
        let _node = tautline_trace::in_node(node.traced.id());
        let limits = of.response.limits();
        let raw = node.participant.create_raw_server(name, &of.service_type, depth.room, limits)?;
        let listeners = &node.context().listeners;
        let service = Service {
            node: node.into(),
            of,
            qos: qos::to_ros(&wanted, false),
            depth,
            listeners: listeners.of_responses(name),
            end: ReceivingEndpoint::new(node, raw, listeners.of_requests(name))?,
        };
        node.hand_out(name, service, |_| ())
    }

    fn rmw_destroy_service(node: *mut rmw_node_t => behind, service: *mut rmw_service_t) {
        // SAFETY: rmw's contract.
        unsafe { node.destroy(service) }
    }

    fn rmw_take_request(
        service: *const rmw_service_t => behind,
        header: *mut rmw_service_info_t => place "the header",
        request: *mut c_void => present "the request",
        taken: *mut bool => place "taken",
    ) {
        *taken = false;
        service.node.check_process()?;
        // At the limit of held samples: the threads that are in a take will release some.
        let oldest = service.end.take(|raw| {
            let late = |request: RawSample| service.refuse(raw, &request, "newer ones fill its depth");
            service.depth.take(raw.requests(), || raw.try_take(), late)
        });
        let Ok(Some(sample)) = oldest else { return Ok(()) };
        // SAFETY: rmw's contract: a request of this type.
        if let Err(error) = unsafe { service.of.request.callbacks.read(sample.body(), true, request) } {
            let reason = format!("it is not a valid {}: {error:?}", service.of.service_type.request.name);
            service.end.with(|raw| service.refuse(raw, &sample, &reason));
            return Ok(());
        }
        let info = sample.info();
        *header = info_of(&info, service.end.begin(&info));
        *taken = true;
        Ok(())
    }

    fn rmw_send_response(
        service: *const rmw_service_t => behind,
        header: *mut rmw_request_id_t => place "the header",
        response: *mut c_void => present "the response",
    ) {
        service.node.check_process()?;
        let sequence_number = u64::try_from(header.sequence_number)
            .map_err(|_| Error::invalid("the request's sequence number is negative"))?;
        let id = RequestId { client: Gid(header.writer_guid.map(|byte| byte as _)), sequence_number };
        let callbacks = service.of.response.callbacks;
        // SAFETY: rmw's contract: a response of this type.
        let estimate = unsafe { callbacks.estimate(response)? };
        let sent = service.end.with(|raw| {
            let mut loan = raw.loan(id, estimate)?;
            // SAFETY: as above.
            let written = unsafe { callbacks.write(response, &mut loan) }.map_err(Failed::Write)?;
            loan.truncate(written);
            loan.send().map_err(|unsent| Failed::from(unsent.error))
        });
        service.listeners.notify();
        match sent {
            // The client has ended: not an error of the server.
            Ok(()) | Err(Failed::Send(ServiceError::ClientGone { .. })) => Ok(()),
            Err(Failed::Send(
                error @ (ServiceError::ClientUnreachable { .. } | ServiceError::ResponsesFull { .. }),
            )) => Err(Error::new(RET_TIMEOUT, error.to_string())),
            Err(Failed::Send(error)) => Err(error.into()),
            Err(Failed::Write(error)) => Err(error),
        }
    }

    fn rmw_service_request_subscription_get_actual_qos(
        service: *const rmw_service_t => behind,
        profile: *mut rmw_qos_profile_t => place "the QoS profile",
    ) {
        *profile = service.qos;
        Ok(())
    }

    fn rmw_service_response_publisher_get_actual_qos(
        service: *const rmw_service_t => behind,
        profile: *mut rmw_qos_profile_t => place "the QoS profile",
    ) {
        *profile = service.qos;
        Ok(())
    }

    fn rmw_service_set_on_new_request_callback(
        service: *mut rmw_service_t => behind,
        callback: rmw_event_callback_t,
        data: *const c_void,
    ) {
        service.end.set_on_new(service.node.context(), callback, data)
    }
}

/// Why a response was not sent.
enum Failed {
    Write(Error),
    Send(ServiceError),
}

impl From<ServiceError> for Failed {
    fn from(error: ServiceError) -> Self {
        Failed::Send(error)
    }
}
