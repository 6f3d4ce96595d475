// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::future::BoxFuture;
use std::sync::{Mutex, MutexGuard, PoisonError};
use tautline::codec::ServiceCodec;
use tautline::{Error, Json, ResponseFuture, Result};

/// A client that can wait for its server: see [`Node::is_available`](crate::Node::is_available).
pub trait IsAvailablePollable: sealed::Wait {}

impl<T: ServiceCodec> IsAvailablePollable for Client<T> {}
impl IsAvailablePollable for ClientUntyped {}

pub(crate) mod sealed {
    use super::{BoxFuture, Result};

    pub trait Wait {
        /// Waits until there is a server, if there is room for one more wait.
        fn wait(&self) -> Result<BoxFuture<'static, Result<()>>>;
    }
}

/// A client with r2r's API, for several threads; it wraps a [`tautline::Client`].
#[derive(Debug)]
pub struct Client<T: ServiceCodec>(Mutex<tautline::Client<T>>);

impl<T: ServiceCodec<Error: Into<Error>>> Client<T> {
    /// As [`tautline::Client::request`].
    ///
    /// # Real-time
    /// Takes a lock that other threads hold while they use this client.
    ///
    /// # Errors
    /// As there.
    pub fn request(&self, msg: &T::Request) -> Result<ResponseFuture<T>> {
        lock(&self.0).request(msg)
    }
}

impl<T: ServiceCodec> sealed::Wait for Client<T> {
    fn wait(&self) -> Result<BoxFuture<'static, Result<()>>> {
        Ok(Box::pin(lock(&self.0).wait_for_service()?))
    }
}

impl<T: ServiceCodec> From<tautline::Client<T>> for Client<T> {
    fn from(client: tautline::Client<T>) -> Self {
        Client(Mutex::new(client))
    }
}

fn lock<T: ServiceCodec>(client: &Mutex<tautline::Client<T>>) -> MutexGuard<'_, tautline::Client<T>> {
    client.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A client of a type that is known by name, with r2r's API, for several threads; it wraps a [`tautline::Client`] of [`Json`].
#[derive(Debug)]
pub struct ClientUntyped(pub(crate) Client<Json>);

impl ClientUntyped {
    /// As [`Client::request`]. The inner result of the future is an error if the response is not of the type.
    ///
    /// # Errors
    /// [`Error::Message`] if it is not a request of the type; as [`Client::request`].
    pub fn request(&self, msg: serde_json::Value) -> Result<ResponseFuture<Json>> {
        self.0.request(&Json(msg))
    }
}

impl sealed::Wait for ClientUntyped {
    fn wait(&self) -> Result<BoxFuture<'static, Result<()>>> {
        sealed::Wait::wait(&self.0)
    }
}
