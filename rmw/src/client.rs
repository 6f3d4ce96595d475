// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clients of services. Requests are queued while there is no server.

use crate::bindings::*;
use crate::distro;
use crate::end::{MessageQueue, ReceivingEndpoint};
use crate::error::{Error, Result};
use crate::handle::{behind, endpoint_name, exported, gid_to_ros, handle, place};
use crate::node::NodeOfEndpoint;
use crate::on_new::Listeners;
use crate::qos;
use crate::service::{Depth, info_of};
use crate::types::ServiceSupport;
use std::collections::VecDeque;
use std::ffi::{c_char, c_void};
use std::future::poll_fn;
use std::sync::{Arc, Weak};
use std::task::Poll;
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::{Alarm, Events};
use tautline_transport::{Gid, LoanError, QueuedClient, RawSample, RawSubscription, ServiceError};

pub(crate) struct Client {
    node: NodeOfEndpoint,
    of: ServiceSupport,
    qos: rmw_qos_profile_t,
    depth: Depth,
    gid: Gid,
    /// Servers of this context whose callbacks are called after a request.
    listeners: Arc<Listeners>,
    end: Arc<ReceivingEndpoint<Asking>>,
}

handle!(rmw_client_t, Client, "the client");

pub(crate) struct Asking {
    pub(crate) raw: QueuedClient,
    /// Requests that found no server or a full queue, with their sequence numbers.
    unsent: VecDeque<(u64, Vec<u8>)>,
    /// Whether the first of them could not be sent although a server has room.
    pub(crate) has_failed: bool,
}

/// Maximum of requests per client that wait for a server; more are refused.
const MOST_UNSENT: usize = Depth::ROOM;
/// The interval at which a waiting request is sent again that could not be sent: nothing tells when there is memory for it.
const RETRY_NS: u64 = 100_000_000;

impl MessageQueue for Asking {
    const IS_TOPIC: bool = false;

    fn subscription(&self) -> &RawSubscription {
        self.raw.responses()
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.end.close();
    }
}

/// Whether an unsent request should wait.
fn is_to_wait(error: &ServiceError) -> bool {
    matches!(error, ServiceError::NoServer { .. } | ServiceError::RequestsFull { .. })
}

impl Asking {
    /// Sends waiting requests in order, as far as servers have room.
    fn flush(&mut self) -> std::result::Result<(), ServiceError> {
        while self.flush_one()? {}
        Ok(())
    }

    /// Sends the first waiting request, if there is one and a server has room. Returns whether it did.
    fn flush_one(&mut self) -> std::result::Result<bool, ServiceError> {
        let Some((number, body)) = self.unsent.front() else { return Ok(false) };
        let mut loan = self.raw.loan(body.len())?;
        loan.copy_from_slice(body);
        match self.raw.send(*number, loan) {
            Ok(()) => {}
            Err(unsent) if is_to_wait(&unsent.error) => return Ok(false),
            Err(unsent) => return Err(unsent.error),
        }
        self.has_failed = false;
        self.unsent.pop_front();
        Ok(true)
    }

    /// Sends or queues a request of at most `len_bytes`, written by `write`. Returns its sequence number.
    fn send(&mut self, len_bytes: usize, write: impl FnOnce(&mut [u8]) -> Result<usize>) -> Result<u64> {
        self.flush()?;
        if self.unsent.len() >= MOST_UNSENT {
            let service = self.raw.service();
            return Err(Error::other(format!(
                "service '{service}': {MOST_UNSENT} requests already wait for a server, the limit: start the server, or send fewer"
            )));
        }
        let mut loan = self.raw.loan(len_bytes)?;
        let written = write(&mut loan)?;
        loan.truncate(written);
        let number = self.raw.reserve();
        if !self.unsent.is_empty() {
            let body = loan.to_vec();
            drop(loan);
            self.unsent.push_back((number, body));
            return Ok(number);
        }
        match self.raw.send(number, loan) {
            Ok(()) => Ok(number),
            Err(unsent) if is_to_wait(&unsent.error) => {
                let body = unsent.loan.to_vec();
                drop(unsent);
                self.unsent.push_back((number, body));
                Ok(number)
            }
            Err(unsent) => Err(unsent.error.into()),
        }
    }
}

impl Client {
    /// The endpoint, whose responses wake wait sets.
    pub(crate) fn end(&self) -> &ReceivingEndpoint<Asking> {
        &self.end
    }
}

/// Sends waiting requests when a server appears or has room, and again while that fails, until the client is destroyed.
async fn serve(end: Weak<ReceivingEndpoint<Asking>>, listeners: Arc<Listeners>, events: Events) {
    let mut retry = None;
    poll_fn(|context| {
        let Some(end) = end.upgrade() else { return Poll::Ready(()) };
        let mut flushed = end.with(|asking| {
            asking.raw.wake_once(context.waker());
            asking.flush_one()
        });
        // One request per lock, so that another thread waits for one of them, not for all.
        while let Ok(true) = flushed {
            flushed = end.with(Asking::flush_one);
        }
        listeners.notify();
        match flushed {
            Ok(_) => retry = None,
            Err(ServiceError::Loan { source: LoanError::Ended, .. }) => return Poll::Ready(()),
            Err(error) => {
                if !end.with(|asking| std::mem::replace(&mut asking.has_failed, true)) {
                    tracing::warn!("a request was not sent, and is sent again until that succeeds: {error}");
                }
                retry = retry.take().or_else(|| Alarm::new(&events).ok());
                if let Some(alarm) = &mut retry {
                    alarm.set(Some(monotonic_ns() + RETRY_NS));
                    let _ = alarm.poll(context);
                }
            }
        }
        Poll::Pending
    })
    .await;
}

exported! {
    fn rmw_create_client(
        node: *const rmw_node_t => behind,
        support: *const rosidl_service_type_support_t,
        name: *const c_char,
        profile: *const rmw_qos_profile_t => given "the QoS profile",
    ) -> *mut rmw_client_t {
        node.check_process()?;
        // SAFETY: rmw's contract.
        let (of, name) =
            unsafe { (ServiceSupport::of(support)?, endpoint_name(name, "the service's name", profile)?) };
        let ((wanted, depth), limits) = (Depth::of(profile)?, of.request.limits());
        let _node = tautline_trace::in_node(node.traced.id());
        let raw = node.participant.create_queued_client(name, &of.service_type, depth.room, limits)?;
        let gid = raw.gid();
        let context = node.context();
        let listeners = &context.listeners;
        let (requests, responses) = (listeners.of_requests(name), listeners.of_responses(name));
        let asking = Asking { raw, unsent: VecDeque::new(), has_failed: false };
        let end = ReceivingEndpoint::new(node, asking, responses)?;
        let (served, listeners) = (Arc::downgrade(&end), requests.clone());
        let events = context.helper.events().clone();
        context.helper.run(move || serve(served, requests, events));
        let client =
            Client { node: node.into(), of, qos: qos::to_ros(&wanted, false), depth, gid, listeners, end };
        node.hand_out(name, client, |_| ())
    }

    fn rmw_destroy_client(node: *mut rmw_node_t => behind, client: *mut rmw_client_t) {
        // SAFETY: rmw's contract.
        unsafe { node.destroy(client) }
    }

    fn rmw_send_request(
        client: *const rmw_client_t => behind,
        request: *const c_void => present "the request",
        number: *mut i64 => place "the sequence number",
    ) {
        client.node.check_process()?;
        let callbacks = client.of.request.callbacks;
        // SAFETY: rmw's contract: a request of this type.
        let estimate = unsafe { callbacks.estimate(request)? };
        // SAFETY: as above.
        let write = |body: &mut [u8]| unsafe { callbacks.write(request, body) };
        let sent = client.end.with(|asking| asking.send(estimate, write));
        // Also for queued requests that were sent now.
        client.listeners.notify();
        *number = i64::try_from(sent?).unwrap_or(i64::MAX);
        Ok(())
    }

    fn rmw_take_response(
        client: *const rmw_client_t => behind,
        header: *mut rmw_service_info_t => place "the header",
        response: *mut c_void => present "the response",
        taken: *mut bool => place "taken",
    ) {
        *taken = false;
        client.node.check_process()?;
        // At the limit of held samples: the threads that are in a take will release some.
        let oldest = client.end.take(|asking| {
            let late = |response: RawSample| {
                tracing::warn!(
                    "the response to request {} of service '{}' was dropped: newer ones fill its client's depth",
                    response.info().sequence_number,
                    asking.raw.service()
                );
            };
            client.depth.take(asking.raw.responses(), || asking.raw.try_take(), late)
        });
        let Ok(Some(sample)) = oldest else { return Ok(()) };
        // SAFETY: rmw's contract: a response of this type.
        if let Err(error) = unsafe { client.of.response.callbacks.read(sample.body(), true, response) } {
            // Not an error for the caller, because executors would end.
            tracing::warn!(
                "a response was dropped, because it is not a valid {}: {error:?}",
                client.of.response.name()
            );
            return Ok(());
        }
        let info = sample.info();
        *header = info_of(&info, client.end.begin(&info));
        *taken = true;
        Ok(())
    }

    fn rmw_service_server_is_available(
        node: *const rmw_node_t,
        client: *const rmw_client_t,
        is_available: *mut bool,
    ) {
        if node.is_null() || client.is_null() || is_available.is_null() {
            return Err(distro::null_argument("the node, the client or the result pointer"));
        }
        // SAFETY: rmw's contract.
        let (client, is_available) = unsafe {
            behind(node)?;
            (behind(client)?, place(is_available, "the answer")?)
        };
        client.node.check_process()?;
        *is_available = client.end.with(|asking| asking.raw.server_count()) > 0;
        Ok(())
    }

    fn rmw_get_gid_for_client(client: *const rmw_client_t => behind, gid: *mut rmw_gid_t => place "the gid") {
        *gid = gid_to_ros(client.gid);
        Ok(())
    }

    fn rmw_client_request_publisher_get_actual_qos(
        client: *const rmw_client_t => behind,
        profile: *mut rmw_qos_profile_t => place "the QoS profile",
    ) {
        *profile = client.qos;
        Ok(())
    }

    fn rmw_client_response_subscription_get_actual_qos(
        client: *const rmw_client_t => behind,
        profile: *mut rmw_qos_profile_t => place "the QoS profile",
    ) {
        *profile = client.qos;
        Ok(())
    }

    fn rmw_client_set_on_new_response_callback(
        client: *mut rmw_client_t => behind,
        callback: rmw_event_callback_t,
        data: *const c_void,
    ) {
        client.end.set_on_new(client.node.context(), callback, data)
    }
}
