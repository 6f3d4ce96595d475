// SPDX-License-Identifier: MIT OR Apache-2.0
//! Typed clients and servers: a thin layer over the untyped ones.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::error::{SendError, TakeError, TransportError};
use crate::memory::header::MessageInfo;
use crate::qos::Limits;
use crate::service::client::{Availability, RawClient, RawPending};
use crate::service::error::ServiceError;
use crate::service::server::{RawServer, RequestId};
use crate::service::service_type::ServiceType;
use crate::topic::participant::Participant;
use crate::topic::subscription::RawSubscription;
use crate::topic::typed::hot::{Loan, Sample, Unwritten, poll_take, take_valid};
use crate::topic::typed::{Codec, Decode};
use core::fmt;
use core::future::Future;
use core::ops::{Deref, DerefMut};
use core::pin::Pin;
use core::task::{Context, Poll};
use std::sync::Arc;
use tautline_msgs::cdr::{EncodeError, Fill, WriteError};
use tautline_msgs::{Plain, Service};

/// How the requests and responses of a service are written and read. Every [`Service`] is its own codec.
pub trait ServiceCodec: Sized + 'static {
    /// The request, which a client sends.
    type Request: Codec;
    /// The response of the server.
    type Response: Codec<Invalid = <Self::Request as Codec>::Invalid>;
    /// Why a request or a response was not sent.
    type Error: From<ServiceError>;

    /// The error for a value that is not a valid request or response.
    fn invalid(service: &Arc<str>, invalid: <Self::Request as Codec>::Invalid) -> Self::Error;
}

impl<S: Service> ServiceCodec for S {
    type Request = S::Request;
    type Response = S::Response;
    type Error = ServiceError;

    fn invalid(service: &Arc<str>, invalid: EncodeError) -> ServiceError {
        ServiceError::Encode { service: service.clone(), source: invalid.into() }
    }
}

/// The definition of requests or responses, as far as it must be known at run time.
type Definition<T> = <T as Decode>::Definition;

/// A client of a service: requests are written in place, responses are read in place.
///
/// May be moved between threads, but only one thread uses it at a time. The futures that wait for its responses
/// may be in any thread.
pub struct Client<S: ServiceCodec> {
    raw: RawClient,
    request: Definition<S::Request>,
    response: Definition<S::Response>,
}

/// The pending response to one request. Dropping it cancels the wait; the server is not notified.
#[must_use = "the response is lost unless it is awaited"]
pub struct PendingResponse<S: ServiceCodec> {
    raw: RawPending,
    definition: Definition<S::Response>,
}

/// A server of a service: requests are read in place, responses are written in place.
///
/// May be moved between threads, but only one thread uses it at a time.
pub struct Server<S: ServiceCodec> {
    raw: RawServer,
    request: Definition<S::Request>,
    response: Definition<S::Response>,
}

/// A request, read in place. At most `Limits::held` requests of one server exist at once.
pub struct Request<S: ServiceCodec> {
    message: Sample<S::Request>,
}

/// A response that is written in place. Dropping it returns the memory without sending.
#[must_use = "the client gets no response until send() is called"]
pub struct Response<'s, S: Service> {
    server: &'s RawServer,
    id: RequestId,
    loan: Loan<'s, S::Response>,
}

/// Memory for a response of stated lengths, not written yet. Dropping it returns the memory.
#[must_use = "the client gets no response until it is written and sent"]
pub struct UnwrittenResponse<'s, 'z, S: Service>
where
    S::Response: Fill,
{
    server: &'s RawServer,
    id: RequestId,
    loan: Unwritten<'s, 'z, S::Response>,
}

impl Participant {
    /// Creates a client of `service`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid name, a limit out of range.
    pub fn create_client<S: Service>(
        &self,
        service: &str,
        limits: Limits,
    ) -> Result<Client<S>, TransportError> {
        Ok(Client::new(self.create_raw_client(service, &ServiceType::of::<S>(), limits)?, (), ()))
    }

    /// Creates a server of `service`, a fully qualified name. `depth` is the number of requests of one client that can
    /// be queued here.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid name, a limit out of range.
    pub fn create_server<S: Service>(
        &self,
        service: &str,
        depth: usize,
        limits: Limits,
    ) -> Result<Server<S>, TransportError> {
        Ok(Server::new(self.create_raw_server(service, &ServiceType::of::<S>(), depth, limits)?, (), ()))
    }
}

impl<S: ServiceCodec> Client<S> {
    /// Wraps an untyped client whose bytes are those of `S`, with the definitions of requests and responses that
    /// must be known at run time.
    pub fn new(raw: RawClient, request: Definition<S::Request>, response: Definition<S::Response>) -> Self {
        Client { raw, request, response }
    }

    /// The untyped client.
    pub fn raw(&self) -> &RawClient {
        &self.raw
    }

    /// The service's fully qualified name.
    pub fn service(&self) -> &str {
        self.raw.service()
    }

    /// The definitions of requests and responses that are known at run time.
    pub fn definitions(&self) -> (&Definition<S::Request>, &Definition<S::Response>) {
        (&self.request, &self.response)
    }

    /// Number of servers.
    pub fn server_count(&self) -> usize {
        self.raw.server_count()
    }

    /// Waits until there is a server. Counts as a pending request.
    ///
    /// # Errors
    /// [`ServiceError::TooManyPending`].
    pub fn availability(&self) -> Result<Availability, ServiceError> {
        self.raw.availability()
    }

    /// Writes `message` into a loan and sends it.
    ///
    /// # Real-time
    /// Like [`send`](Self::send) and the loan, and one copy of the message. Codecs other than Rust types have additional
    /// costs, which they document.
    ///
    /// # Errors
    /// [`ServiceError`], or those of a codec other than a Rust type; nothing was sent.
    pub fn request(&self, message: &S::Request) -> Result<PendingResponse<S>, S::Error> {
        let loan = |len_bytes| Ok(self.raw.loan(len_bytes)?);
        let loan = message
            .encode_into(&self.request, loan, |invalid| S::invalid(&self.raw.state.service, invalid))?;
        Ok(self.pending(self.raw.send(loan).map_err(ServiceError::from)?))
    }

    fn pending(&self, raw: RawPending) -> PendingResponse<S> {
        PendingResponse { raw, definition: self.response.clone() }
    }
}

impl<S: Service> Client<S> {
    /// Loans memory for a request to write in place, as `&mut S::Request`. See [`Publisher::loan`](crate::Publisher::loan): a loan
    /// stays in its thread, so a future that may change threads sends it before it waits, in a block of its own or with
    /// [`request_with`](Self::request_with).
    ///
    /// # Real-time
    /// As [`Publisher::loan`](crate::Publisher::loan).
    ///
    /// # Errors
    /// [`ServiceError::Loan`].
    pub fn loan(&self) -> Result<Loan<'_, S::Request>, ServiceError>
    where
        S::Request: Plain,
    {
        Loan::of_plain(self.raw.publisher()).map_err(|source| self.raw.state.loan_error(source))
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
        sizes: <S::Request as Fill>::Sizes<'s>,
    ) -> Result<Unwritten<'_, 's, S::Request>, ServiceError>
    where
        S::Request: Fill,
    {
        Unwritten::of_sizes(self.raw.publisher(), sizes).map_err(|source| self.raw.state.loan_error(source))
    }

    /// Sends a request that was written in place, to every server. The first response counts.
    ///
    /// # Real-time and errors
    /// As [`RawClient::send`].
    pub fn send<'c>(
        &'c self,
        request: Loan<'c, S::Request>,
    ) -> Result<PendingResponse<S>, SendError<Loan<'c, S::Request>, ServiceError>> {
        let sent = self.raw.send(request.into_raw());
        sent.map(|raw| self.pending(raw)).map_err(|unsent| unsent.map(Loan::from_raw))
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
        write: impl FnOnce(&mut S::Request),
    ) -> Result<PendingResponse<S>, ServiceError>
    where
        S::Request: Plain,
    {
        let mut request = self.loan()?;
        write(&mut request);
        Ok(self.send(request)?)
    }
}

impl<S: ServiceCodec> Future for PendingResponse<S> {
    type Output = Result<Sample<S::Response>, ServiceError>;

    /// # Real-time
    /// As [`RawPending`]; the response is checked: see [`Message::view`](tautline_msgs::Message::view).
    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        Pin::new(&mut self.raw).poll(context).map(|response| {
            let invalid = |source| ServiceError::Invalid { service: self.raw.state.service.clone(), source };
            Sample::new(response?, &self.definition).map_err(|error| invalid(error.into()))
        })
    }
}

impl<S: ServiceCodec> Server<S> {
    /// Wraps an untyped server whose bytes are those of `S`, with the definitions of requests and responses that
    /// must be known at run time.
    pub fn new(raw: RawServer, request: Definition<S::Request>, response: Definition<S::Response>) -> Self {
        Server { raw, request, response }
    }

    /// The untyped server.
    pub fn raw(&self) -> &RawServer {
        &self.raw
    }

    /// The service's fully qualified name.
    pub fn service(&self) -> &str {
        self.raw.service()
    }

    /// The subscription to the requests.
    pub fn requests(&self) -> &RawSubscription {
        self.raw.requests()
    }

    /// Takes the oldest request, if there is one. Invalid requests are counted and skipped, and their clients are notified that
    /// there is no response ([`RawServer::refuse`]).
    ///
    /// # Real-time
    /// As [`Subscription::try_take_valid`](crate::Subscription::try_take_valid), and [`RawServer::refuse`] for each invalid one.
    pub fn try_take(&self) -> Result<Option<Request<S>>, TakeError> {
        let taken = take_valid(self.requests(), &self.request, |invalid| self.refuse(invalid))?;
        Ok(taken.map(|message| Request { message }))
    }

    /// Polls for a request.
    ///
    /// # Real-time
    /// As [`try_take`](Self::try_take).
    pub fn poll_take(&self, context: &mut Context<'_>) -> Poll<Option<Request<S>>> {
        let taken = poll_take(self.requests(), &self.request, context, |invalid| self.refuse(invalid));
        taken.map(|message| message.map(|message| Request { message }))
    }

    /// Notifies the client of an invalid request. If there is no memory for that, the client continues to wait.
    fn refuse(&self, invalid: MessageInfo) {
        let _ = self.raw.refuse(RequestId::of(invalid));
    }

    /// Writes `message` into a loan and sends it.
    ///
    /// # Real-time
    /// Like the loan and [`Response::send`], and one copy of the message. Codecs other than Rust types have additional
    /// costs, which they document.
    ///
    /// # Errors
    /// [`ServiceError`], or those of a codec other than a Rust type; nothing was sent.
    pub fn respond(&self, id: RequestId, message: &S::Response) -> Result<(), S::Error> {
        let loan = |len_bytes| Ok(self.raw.loan(id, len_bytes)?);
        let loan =
            message.encode_into(&self.response, loan, |invalid| S::invalid(&self.raw.service, invalid))?;
        Ok(loan.send().map_err(ServiceError::from)?)
    }
}

impl<S: Service> Server<S> {
    /// Loans memory for the response to a request, to write in place as `&mut S::Response`.
    ///
    /// # Real-time
    /// As [`Publisher::loan`](crate::Publisher::loan), and O(clients).
    ///
    /// # Errors
    /// [`ServiceError::ClientGone`], [`ServiceError::ClientUnreachable`], [`ServiceError::Loan`].
    pub fn loan(&self, id: RequestId) -> Result<Response<'_, S>, ServiceError>
    where
        S::Response: Plain,
    {
        self.raw.subscription_of(id.client)?;
        let loan = Loan::of_plain(&self.raw.responses).map_err(|source| self.raw.loan_error(source))?;
        Ok(Response { server: &self.raw, id, loan })
    }

    /// Loans memory for a response of these lengths, to be [written](UnwrittenResponse::write) in place.
    ///
    /// # Real-time
    /// As [`Publisher::loan_with`](crate::Publisher::loan_with), and O(clients).
    ///
    /// # Errors
    /// [`ServiceError::ClientGone`], [`ServiceError::ClientUnreachable`], [`ServiceError::Loan`].
    pub fn loan_with<'z>(
        &self,
        id: RequestId,
        sizes: <S::Response as Fill>::Sizes<'z>,
    ) -> Result<UnwrittenResponse<'_, 'z, S>, ServiceError>
    where
        S::Response: Fill,
    {
        self.raw.subscription_of(id.client)?;
        let loan = Unwritten::of_sizes(&self.raw.responses, sizes);
        let loan = loan.map_err(|source| self.raw.loan_error(source))?;
        Ok(UnwrittenResponse { server: &self.raw, id, loan })
    }
}

impl<S: ServiceCodec> Request<S> {
    /// Identifies the request and its client; a response needs it.
    pub fn id(&self) -> RequestId {
        RequestId::of(self.message.info())
    }

    /// The request, in shared memory.
    pub fn message(&self) -> &Sample<S::Request> {
        &self.message
    }
}

/// The sample, which derefs to the request itself if that is plain.
impl<S: ServiceCodec> Deref for Request<S> {
    type Target = Sample<S::Request>;

    fn deref(&self) -> &Sample<S::Request> {
        &self.message
    }
}

impl<'s, 'z, S: Service> UnwrittenResponse<'s, 'z, S>
where
    S::Response: Fill,
{
    /// Lets `write` set each field in place. See [`Unwritten::write`].
    ///
    /// # Real-time and errors
    /// As [`Unwritten::write`].
    pub fn write(
        self,
        write: impl for<'a> FnOnce(&mut <S::Response as Fill>::Writer<'a, 'z>) -> Result<(), WriteError>,
    ) -> Result<Response<'s, S>, WriteError> {
        let UnwrittenResponse { server, id, loan } = self;
        Ok(Response { server, id, loan: loan.write(write)? })
    }
}

impl<S: Service> Response<'_, S> {
    /// Sends the response to the requesting client.
    ///
    /// # Real-time and errors
    /// As [`RawResponse::send`](crate::RawResponse::send).
    #[allow(clippy::result_large_err, reason = "it gives the response back")]
    pub fn send(self) -> Result<(), SendError<Self, ServiceError>> {
        let Response { server, id, loan } = self;
        let unsent = server.send(id, loan.into_raw());
        unsent.map_err(|unsent| unsent.map(|loan| Response { server, id, loan: Loan::from_raw(loan) }))
    }
}

impl<S: Service> Deref for Response<'_, S>
where
    S::Response: Plain,
{
    type Target = S::Response;

    fn deref(&self) -> &S::Response {
        &self.loan
    }
}

impl<S: Service> DerefMut for Response<'_, S>
where
    S::Response: Plain,
{
    fn deref_mut(&mut self) -> &mut S::Response {
        &mut self.loan
    }
}

tautline_rt::debug_fields!([S: ServiceCodec] Client<S>, |this| service = this.raw.service());

impl<S: ServiceCodec> fmt::Debug for PendingResponse<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.raw.fmt(f)
    }
}

tautline_rt::debug_fields!([S: ServiceCodec] Server<S>, |this| service = this.service());

tautline_rt::debug_fields!([S: ServiceCodec] Request<S>, |this| id = this.id());

tautline_rt::debug_fields!([S: Service] Response<'_, S>, |this| id = this.id);

impl<S: Service> fmt::Debug for UnwrittenResponse<'_, '_, S>
where
    S::Response: Fill,
{
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("UnwrittenResponse").field("id", &self.id).finish_non_exhaustive()
    }
}
