// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::message::NativeMsg;
use futures::TryFutureExt;
use tautline::{Error, Json, Loan, Message, Plain, Result};

/// A publisher with r2r's API; it wraps a [`tautline::Publisher`].
#[derive(Debug)]
pub struct Publisher<T: Message>(tautline::Publisher<T>);

impl<T: Message> Publisher<T> {
    /// As [`tautline::Publisher::publish`].
    ///
    /// # Errors
    /// [`Error::Publish`].
    pub fn publish(&self, msg: &T) -> Result<()> {
        Ok(self.0.publish(msg)?)
    }

    /// [`tautline::Publisher::loan`]. The loan is published with its own [`publish`](Loan::publish).
    ///
    /// # Errors
    /// [`Error::Publish`]: the maximum number of loans is in use.
    pub fn borrow_loaned_message(&self) -> Result<Loan<'_, T>>
    where
        T: Plain,
    {
        Ok(self.0.loan()?)
    }

    /// Publishes a message in r2r's form for C.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_native(&self, msg: &mut NativeMsg<T>) -> Result<()> {
        self.publish(msg)
    }

    /// Number of subscriptions on this host, including those of this process.
    ///
    /// # Errors
    /// None.
    pub fn get_inter_process_subscription_count(&self) -> Result<usize> {
        Ok(self.0.subscription_count())
    }

    /// As [`tautline::Publisher::wait_for_subscriptions`].
    pub fn wait_for_inter_process_subscribers(
        &self,
    ) -> Result<impl Future<Output = Result<()>> + Send + use<T>> {
        Ok(self.0.wait_for_subscriptions()?.map_err(Error::from))
    }
}

/// A publisher of a type that is known by its definition, with r2r's API; it wraps a [`tautline::Publisher`] of [`Json`].
#[derive(Debug)]
pub struct PublisherUntyped(tautline::Publisher<Json>);

impl PublisherUntyped {
    /// As [`tautline::Publisher::publish`].
    ///
    /// # Errors
    /// [`Error::Message`] with the field if it is not a message of the type; [`Error::Publish`].
    pub fn publish(&self, msg: serde_json::Value) -> Result<()> {
        self.0.publish(&Json(msg))
    }

    /// Number of subscriptions on this host, including those of this process.
    ///
    /// # Errors
    /// None.
    pub fn get_inter_process_subscription_count(&self) -> Result<usize> {
        Ok(self.0.subscription_count())
    }

    /// As [`tautline::Publisher::wait_for_subscriptions`].
    pub fn wait_for_inter_process_subscribers(
        &self,
    ) -> Result<impl Future<Output = Result<()>> + Send + use<>> {
        Ok(self.0.wait_for_subscriptions()?.map_err(Error::from))
    }
}

beneath!(Publisher<T: Message>);
beneath!(PublisherUntyped = tautline::Publisher<Json>);
