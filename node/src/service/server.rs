// SPDX-License-Identifier: MIT OR Apache-2.0
//! Servers: requests in place, and an adapter for owned requests.

use crate::error::{Error, Result};
use crate::subscription::{SampleSource, Samples};
use futures::Stream;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tautline_msgs::Service;
use tautline_msgs::cdr::Fill;
use tautline_rt::PiMutex;
use tautline_transport::{
    Decode, RawSubscription, Request, RequestId, Response, ServiceCodec, ServiceError, SubscriptionCounters,
    TakeError, UnwrittenResponse,
};

/// A server in place: a stream of [`Request`]s, each read where the client wrote it, with functions that write responses where
/// the client reads them.
///
/// On a callback thread each request is a job: its response time counts from the request's release, and the next poll of this
/// stream ends it. May be moved between threads, but only one thread uses it at a time.
///
/// ```
/// # #[cfg(feature = "example_interfaces")] {
/// use futures::StreamExt;
/// use tautline::example_interfaces::srv::AddTwoInts;
/// use tautline::{CallbackOptions, Context, Node, Qos, Realtime};
///
/// let ctx = Context::builder().domain(129).realtime(Realtime::Off).build()?;
/// let mut node = Node::create(ctx.clone(), "example", "")?;
/// let mut service = node.create_service::<AddTwoInts::Service>("/sum", Qos::default())?;
/// node.spawn_callback(CallbackOptions::fifo(20), async move {
///     while let Some(request) = service.next().await {
///         let mut response = service.loan(&request).expect("the client waits");
///         response.sum = request.a + request.b; // both in shared memory
///         response.send().expect("the client takes what it asked for");
///     }
/// })?;
/// let client = node.create_client::<AddTwoInts::Service>("/sum")?;
/// let stop = ctx.events().clone();
/// node.spawn_callback(CallbackOptions::fifo(10), async move {
///     let response = client.request_with(|request| (request.a, request.b) = (1, 2)).expect("there is a server");
///     assert_eq!(response.await.expect("it answers").sum, 3);
///     stop.stop();
/// })?;
/// ctx.spin()?;
/// # }
/// # Ok::<(), tautline::Error>(())
/// ```
#[must_use = "nothing is served unless it is polled; dropping it ends the service"]
pub struct Server<T: ServiceCodec> {
    requests: Samples<tautline_transport::Server<T>>,
}

impl<T: ServiceCodec> Server<T> {
    pub(super) fn new(server: tautline_transport::Server<T>) -> Self {
        Server { requests: Samples::new(server) }
    }

    fn server(&self) -> &tautline_transport::Server<T> {
        self.requests.source()
    }

    /// Writes `response` into a loan and sends it.
    ///
    /// # Real-time
    /// As [`loan_with`](Self::loan_with) and [`Response::send`], and one copy of the message. Codecs other than Rust types have
    /// additional costs: JSON allocates.
    ///
    /// # Errors
    /// As [`loan`](Self::loan) and [`Response::send`]; codecs other than Rust types have their own errors.
    pub fn respond(&self, request: &Request<T>, response: &T::Response) -> Result<(), T::Error> {
        self.server().respond(request.id(), response)
    }

    /// The stream of owned requests, copied out of shared memory; respond to each with [`ServiceRequest::respond`], in any thread. The
    /// service ends when the stream and the last request are dropped.
    pub fn owned(self) -> impl Stream<Item = ServiceRequest<T>> + Unpin + Send + use<T> {
        Requests { service: Arc::new(PiMutex::new(self)) }
    }

    /// Received requests, invalid requests, highest queue fill: readable from any thread.
    pub fn counters(&self) -> Arc<SubscriptionCounters> {
        self.requests.counters()
    }

    /// The service's fully qualified name.
    pub fn service_name(&self) -> &str {
        self.server().service()
    }
}

impl<T: Service> Server<T> {
    /// Loans memory for the response to `request`, to write in place as `&mut T::Response`. A future that holds it across
    /// an `.await` is not `Send`: await before the loan, or run the future with
    /// [`Node::spawn_local`](crate::Node::spawn_local).
    ///
    /// # Real-time
    /// Wait-free, O(clients); no allocation; no syscall.
    ///
    /// # Errors
    /// [`ServiceError::ClientGone`], [`ServiceError::Loan`].
    pub fn loan(&self, request: &Request<T>) -> Result<Response<'_, T>, ServiceError>
    where
        T::Response: tautline_msgs::Plain,
    {
        self.server().loan(request.id())
    }

    /// Loans memory for a response of these lengths, to be [written](UnwrittenResponse::write) in place.
    ///
    /// # Real-time
    /// As [`loan`](Self::loan); linear in the number of fields; a response longer than all before and than
    /// `Limits::message_bytes` needs a larger segment: allocates, maps memory.
    ///
    /// # Errors
    /// As [`loan`](Self::loan).
    pub fn loan_with<'z>(
        &self,
        request: &Request<T>,
        sizes: <T::Response as Fill>::Sizes<'z>,
    ) -> Result<UnwrittenResponse<'_, 'z, T>, ServiceError>
    where
        T::Response: Fill,
    {
        self.server().loan_with(request.id(), sizes)
    }
}

impl<T: ServiceCodec> Stream for Server<T> {
    type Item = Request<T>;

    /// # Real-time
    /// Wait-free; no allocation; the request is checked: see [`Message::view`](crate::Message::view). Ends with the node.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Request<T>>> {
        self.requests.poll_next(context)
    }
}

impl<T: ServiceCodec> SampleSource for tautline_transport::Server<T> {
    type Sample = Request<T>;

    fn raw(&self) -> &RawSubscription {
        self.requests()
    }

    fn try_take_valid(&mut self) -> Result<Option<Request<T>>, TakeError> {
        self.try_take()
    }

    fn poll_take(&mut self, context: &mut Context<'_>) -> Poll<Option<Request<T>>> {
        tautline_transport::Server::poll_take(self, context)
    }

    fn released_ns(request: &Request<T>) -> u64 {
        request.info().released_ns
    }
}

/// A service's stream of requests with owned messages.
struct Requests<T: ServiceCodec> {
    service: Arc<PiMutex<Server<T>>>,
}

impl<T: ServiceCodec> Stream for Requests<T> {
    type Item = ServiceRequest<T>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<ServiceRequest<T>>> {
        let taken = self.service.lock().requests.poll_next(context);
        // Copied after the lock was released, so that other threads can take and respond.
        taken.map(|request| {
            let request = request?;
            let message = request.message().to_owned();
            let reply = Reply { id: request.id(), service: self.service.clone() };
            Some(ServiceRequest { message, reply })
        })
    }
}

/// A request with an owned message. Respond with [`respond`](Self::respond), now or later, in any thread.
pub struct ServiceRequest<T: ServiceCodec> {
    /// The request's message.
    pub message: <T::Request as Decode>::Owned,
    reply: Reply<T>,
}

impl<T: ServiceCodec<Error: Into<Error>>> ServiceRequest<T> {
    /// Responds to the request. If its client has ended meanwhile, nothing happens, as in ROS 2.
    ///
    /// # Real-time
    /// Takes a lock with priority inheritance, which threads hold while they write and send a response of this service, or take a
    /// request. [`Server::respond`] takes none.
    ///
    /// # Errors
    /// [`Error::Service`](crate::Error::Service): the client's queue is full or cannot be reached, the response cannot be written. The request
    /// then ends without a response.
    pub fn respond(self, msg: T::Response) -> Result<()> {
        self.reply.respond(&msg)
    }

    /// Identifies the request and its client.
    pub fn id(&self) -> RequestId {
        self.reply.id
    }

    /// The request's message, and the means to respond.
    #[cfg(feature = "action_msgs")]
    pub(crate) fn into_parts(self) -> (<T::Request as Decode>::Owned, Reply<T>) {
        (self.message, self.reply)
    }
}

impl<T: ServiceCodec> Clone for ServiceRequest<T>
where
    <T::Request as Decode>::Owned: Clone,
{
    fn clone(&self) -> Self {
        let Reply { id, service } = &self.reply;
        ServiceRequest { message: self.message.clone(), reply: Reply { id: *id, service: service.clone() } }
    }
}

/// The means to respond to one request.
pub(crate) struct Reply<T: ServiceCodec> {
    id: RequestId,
    /// Held while a response is written and sent, and while requests are taken.
    service: Arc<PiMutex<Server<T>>>,
}

impl<T: ServiceCodec<Error: Into<Error>>> Reply<T> {
    /// Whether the client of the request still exists.
    #[cfg(feature = "action_msgs")]
    pub(crate) fn is_awaited(&self) -> bool {
        let service = self.service.lock();
        service.server().raw().can_answer(self.id.client)
    }

    pub(crate) fn respond(self, msg: &T::Response) -> Result<()> {
        let service = self.service.lock();
        match service.server().respond(self.id, msg).map_err(Into::into) {
            Err(Error::Service(ServiceError::ClientGone { .. })) => Ok(()),
            Err(error) => {
                // The request cannot be answered again: its client would wait for ever.
                let _ = service.server().raw().refuse(self.id);
                Err(error)
            }
            Ok(()) => Ok(()),
        }
    }
}

tautline_rt::debug_fields!([T: ServiceCodec] ServiceRequest<T>, |this| id = this.reply.id);

tautline_rt::debug_fields!([T: ServiceCodec] Server<T>, |this| service = this.service_name());
