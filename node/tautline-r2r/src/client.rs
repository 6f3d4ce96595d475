// SPDX-License-Identifier: MIT OR Apache-2.0

use std::sync::{Mutex, MutexGuard, PoisonError};
use tautline::raw::Availability;
use tautline::{IsAvailablePollable, ResponseFuture, Result, Service};

/// A client as r2r has it, for several threads; beneath it is a [`tautline::Client`].
#[derive(Debug)]
pub struct Client<T: Service>(Mutex<tautline::Client<T>>);

impl<T: Service> Client<T> {
    fn client(&self) -> MutexGuard<'_, tautline::Client<T>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// As [`tautline::Client::request`].
    ///
    /// # Real-time
    /// Takes a lock that other threads hold which use this client.
    ///
    /// # Errors
    /// As there.
    pub fn request(&self, msg: &T::Request) -> Result<ResponseFuture<T>> {
        self.client().request(msg)
    }
}

impl<T: Service> IsAvailablePollable for Client<T> {
    fn availability(&self) -> Result<Vec<Availability>> {
        self.client().availability()
    }
}

impl<T: Service> From<tautline::Client<T>> for Client<T> {
    fn from(client: tautline::Client<T>) -> Self {
        Client(Mutex::new(client))
    }
}
