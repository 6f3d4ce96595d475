// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clients with owned messages, and waiting for servers.

use crate::error::{Error, Result};
use std::future::Future;
use std::pin::Pin;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_msgs::Service;
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::{Alarm, Events};
use tautline_transport::{Availability, PendingResponse, RawClient};

/// Asks a service with owned messages. May be used in several threads.
pub struct Client<T: Service> {
    /// Held while a request is written and sent.
    client: Mutex<tautline_transport::Client<T>>,
    events: Events,
}

impl<T: Service> Client<T> {
    pub(super) fn new(client: tautline_transport::Client<T>, events: &Events) -> Self {
        Client { client: Mutex::new(client), events: events.clone() }
    }

    fn client(&self) -> MutexGuard<'_, tautline_transport::Client<T>> {
        self.client.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends a request. The future ends with the response, or with an error when all servers that got the request have gone.
    /// Dropping it cancels the wait. It may outlive the client.
    ///
    /// # Real-time
    /// Takes a lock that only other threads which use this client hold; the response allocates its strings and sequences:
    /// [`create_client_loaned`](crate::Node::create_client_loaned) does neither.
    ///
    /// # Errors
    /// [`Error::Service`]: there is no server, its queue is full, or too many requests wait. Nothing was sent.
    pub fn request(&self, msg: &T::Request) -> Result<ResponseFuture<T>> {
        Ok(ResponseFuture { response: self.client().request(msg)?, limit: None })
    }

    /// [`request`](Self::request), whose future ends with an error if the response does not come in time; with a limit of zero, unless
    /// it is there when the future is first polled.
    ///
    /// # Real-time
    /// As [`request`](Self::request), and claims an alarm, which takes no further lock: wait-free, O(the context's slots), copies
    /// the service's name, and at most one futex wake to set it. Dropping the future is at most one more. After each the sampler looks
    /// through its timers once.
    ///
    /// # Errors
    /// As [`request`](Self::request); [`Error::Transport`] if the context has no slot left for the alarm. The future's:
    /// [`Error::ServiceTimeout`].
    pub fn request_timeout(&self, msg: &T::Request, timeout: Duration) -> Result<ResponseFuture<T>> {
        let client = self.client();
        let limit = Limit::new(&self.events, timeout, client.service())?;
        Ok(ResponseFuture { response: client.request(msg)?, limit: Some(limit) })
    }

    /// The service's fully qualified name.
    pub fn service_name(&self) -> String {
        self.client().service().to_owned()
    }

    /// Number of servers.
    pub fn server_count(&self) -> usize {
        self.client().server_count()
    }
}

/// The response to one request, once it is there. Dropping it cancels the wait; the server is not told.
#[must_use = "the response is lost unless it is awaited"]
pub struct ResponseFuture<T: Service> {
    response: PendingResponse<T>,
    limit: Option<Limit>,
}

/// Until when a response is waited for.
pub(super) struct Limit {
    /// Rings once: a timer would go on for as long as nobody polls.
    alarm: Alarm,
    timeout: Duration,
    service: String,
}

impl Limit {
    pub(super) fn new(events: &Events, timeout: Duration, service: &str) -> Result<Self> {
        let mut alarm = events.alarm()?;
        let timeout_ns = tautline_rt::clock::nanoseconds(timeout);
        alarm.set(Some(monotonic_ns().saturating_add(timeout_ns)));
        Ok(Limit { alarm, timeout, service: service.to_owned() })
    }

    /// Ready when it is too late.
    pub(super) fn poll(&mut self, context: &mut Context<'_>) -> Poll<Error> {
        let Limit { alarm, timeout, service } = self;
        let late = alarm.poll(context);
        late.map(|()| Error::ServiceTimeout { service: service.clone(), timeout: *timeout })
    }
}

impl<T: Service> Future for ResponseFuture<T> {
    type Output = Result<T::Response>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        if let Poll::Ready(response) = Pin::new(&mut self.response).poll(context) {
            return Poll::Ready(response.map(|sample| sample.to_owned()).map_err(Error::from));
        }
        match &mut self.limit {
            Some(limit) => limit.poll(context).map(Err),
            None => Poll::Pending,
        }
    }
}

/// What can wait for its server: see [`Node::is_available`](crate::Node::is_available).
pub trait IsAvailablePollable {
    /// One wait for each service that must have a server.
    ///
    /// # Errors
    /// [`Error::Service`] if the client has no room for one more.
    #[doc(hidden)]
    fn availability(&self) -> Result<Vec<Availability>>;
}

impl<T: Service> IsAvailablePollable for Client<T> {
    fn availability(&self) -> Result<Vec<Availability>> {
        Ok(vec![self.client().availability()?])
    }
}

impl<T: Service> IsAvailablePollable for tautline_transport::Client<T> {
    fn availability(&self) -> Result<Vec<Availability>> {
        IsAvailablePollable::availability(self.raw())
    }
}

impl IsAvailablePollable for RawClient {
    fn availability(&self) -> Result<Vec<Availability>> {
        Ok(vec![RawClient::availability(self)?])
    }
}

impl<T: Service> std::fmt::Debug for Client<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Client").field("service", &self.service_name()).finish_non_exhaustive()
    }
}

impl<T: Service> std::fmt::Debug for ResponseFuture<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ResponseFuture").field("response", &self.response).finish_non_exhaustive()
    }
}
