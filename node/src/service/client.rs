// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clients, and waits for servers.

use crate::error::{Error, Result};
use futures::TryFutureExt;
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_msgs::cdr::Fill;
use tautline_msgs::{Plain, Service};
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::{Alarm, Events};
use tautline_transport::{
    Decode, Loan, PendingResponse, RawClient, SendError, ServiceCodec, ServiceError, Unwritten,
};

/// A client of a service: with owned messages, or with requests that are written, and responses that are read, in shared
/// memory.
///
/// May be moved between threads, but only one thread uses it at a time. The futures that wait for its responses may
/// be in any thread.
pub struct Client<T: ServiceCodec> {
    inner: tautline_transport::Client<T>,
    events: Events,
}

impl<T: ServiceCodec<Error: Into<Error>>> Client<T> {
    pub(super) fn new(inner: tautline_transport::Client<T>, events: &Events) -> Self {
        Client { inner, events: events.clone() }
    }

    /// Sends a request. The future yields the response, or an error when all servers that got the request have ended.
    /// Dropping it cancels the wait. It may outlive the client.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan) and [`send`](Self::send), and one copy of the request; the response allocates its strings and sequences,
    /// unlike that of [`send`](Self::send). Codecs other than Rust types have additional costs: JSON allocates.
    ///
    /// # Errors
    /// [`Error::Service`]: there is no server, its queue is full, or too many requests are pending; codecs other than Rust types have
    /// their own errors. Nothing was sent.
    pub fn request(&self, msg: &T::Request) -> Result<ResponseFuture<T>> {
        Ok(ResponseFuture { response: self.inner.request(msg).map_err(Into::into)?, limit: None })
    }

    /// Like [`request`](Self::request), but the future ends with an error if the response does not arrive in time; with a time-out of
    /// zero, unless it has arrived when the future is first polled.
    ///
    /// # Real-time
    /// Like [`request`](Self::request), and claims an alarm: wait-free, O(the context's slots), copies the service's name, and at most
    /// one futex wake to set the alarm. Dropping the future costs at most one more. After each of these the sampler checks its timers
    /// once.
    ///
    /// # Errors
    /// As [`request`](Self::request); [`Error::Transport`] if the context has no slot left for the alarm. Error of the
    /// future: [`Error::ServiceTimeout`].
    pub fn request_timeout(&self, msg: &T::Request, timeout: Duration) -> Result<ResponseFuture<T>> {
        let limit = Limit::new(&self.events, timeout, self.service_name())?;
        Ok(ResponseFuture { limit: Some(limit), ..self.request(msg)? })
    }

    /// The definitions of requests and responses that are known at run time.
    pub fn definitions(&self) -> (&<T::Request as Decode>::Definition, &<T::Response as Decode>::Definition) {
        self.inner.definitions()
    }

    /// The service's fully qualified name.
    pub fn service_name(&self) -> &str {
        self.inner.service()
    }

    /// Number of servers.
    pub fn server_count(&self) -> usize {
        self.inner.server_count()
    }
}

impl<T: ServiceCodec> Client<T> {
    /// Waits until the service has a server. The wait counts as a pending request of the client.
    ///
    /// # Errors
    /// [`Error::Service`] if the client has no room for another pending request. Error of the future: the
    /// client's node ends.
    pub fn wait_for_service(&self) -> Result<impl Future<Output = Result<()>> + Unpin + Send + use<T>> {
        Ok(self.inner.availability()?.map_err(Error::from))
    }
}

impl<T: Service> Client<T> {
    /// Loans memory for a request to write in place, as `&mut T::Request`. A loan must stay in its thread:
    /// see [`Publisher::loan`](crate::Publisher::loan).
    ///
    /// # Real-time
    /// As [`Publisher::loan`](crate::Publisher::loan).
    ///
    /// # Errors
    /// [`ServiceError::Loan`].
    pub fn loan(&self) -> Result<Loan<'_, T::Request>, ServiceError>
    where
        T::Request: Plain,
    {
        self.inner.loan()
    }

    /// Loans memory for a request of these lengths, to be [written](Unwritten::write) in place.
    ///
    /// # Real-time
    /// As [`Publisher::loan_with`](crate::Publisher::loan_with).
    ///
    /// # Errors
    /// [`ServiceError::Loan`].
    pub fn loan_with<'s>(
        &self,
        sizes: <T::Request as Fill>::Sizes<'s>,
    ) -> Result<Unwritten<'_, 's, T::Request>, ServiceError>
    where
        T::Request: Fill,
    {
        self.inner.loan_with(sizes)
    }

    /// Sends a request that was written in place, to every server. The first response counts; it is read where the server wrote it.
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
        request: Loan<'c, T::Request>,
    ) -> Result<PendingResponse<T>, SendError<Loan<'c, T::Request>, ServiceError>> {
        self.inner.send(request)
    }

    /// Loans memory for a request, lets `write` write it in place, and sends it.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan) and [`send`](Self::send).
    ///
    /// # Errors
    /// [`ServiceError`]; nothing was sent.
    pub fn request_with(
        &self,
        write: impl FnOnce(&mut T::Request),
    ) -> Result<PendingResponse<T>, ServiceError>
    where
        T::Request: Plain,
    {
        self.inner.request_with(write)
    }
}

/// The pending response to one request. Dropping it cancels the wait; the server is not notified.
#[must_use = "the response is lost unless it is awaited"]
pub struct ResponseFuture<T: ServiceCodec> {
    response: PendingResponse<T>,
    limit: Option<Limit>,
}

/// The time limit of a response.
struct Limit {
    /// Rings only once: a timer would continue to ring as long as the future is not polled.
    alarm: Alarm,
    timeout: Duration,
    service: String,
}

impl Limit {
    fn new(events: &Events, timeout: Duration, service: &str) -> Result<Self> {
        let mut alarm = Alarm::new(events)?;
        let timeout_ns = tautline_rt::clock::nanoseconds(timeout);
        alarm.set(Some(monotonic_ns().saturating_add(timeout_ns)));
        Ok(Limit { alarm, timeout, service: service.to_owned() })
    }

    /// Ready with an error when the time-out has expired.
    fn poll(&mut self, context: &mut Context<'_>) -> Poll<Error> {
        let Limit { alarm, timeout, service } = self;
        let late = alarm.poll(context);
        late.map(|()| Error::ServiceTimeout { service: service.clone(), timeout: *timeout })
    }
}

impl<T: ServiceCodec> Future for ResponseFuture<T> {
    type Output = Result<<T::Response as Decode>::Owned>;

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

impl<T: ServiceCodec> AsRef<RawClient> for Client<T> {
    fn as_ref(&self) -> &RawClient {
        self.inner.raw()
    }
}

tautline_rt::debug_fields!([T: ServiceCodec] Client<T>, |this| service = this.inner.service());

tautline_rt::debug_fields!([T: ServiceCodec] ResponseFuture<T>, |this| response = this.response);
