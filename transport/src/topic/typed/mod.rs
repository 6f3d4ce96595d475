// SPDX-License-Identifier: MIT OR Apache-2.0
//! Typed publishers and subscriptions: a thin layer over the untyped ones.

mod codec;
mod hot;

pub use codec::{Codec, Decode};
pub use hot::{Loan, Sample, Unwritten};
pub(crate) use hot::{poll_take, take_valid};

use crate::error::TransportError;
use crate::qos::{Limits, Qos};
use crate::topic::header::Gid;
use crate::topic::publisher::{Gate, PublisherCounters, RawPublisher};
use crate::topic::subscription::{RawSubscription, SubscriptionCounters};
use std::sync::Arc;

/// Publishes messages of type `T` on one topic: written in place after [`loan`](Publisher::loan) or, for variable sizes,
/// [`loan_with`](Publisher::loan_with); or owned messages, with [`publish`](Publisher::publish).
///
/// May be moved between threads, but only one thread uses it at a time.
pub struct Publisher<T: Codec> {
    raw: RawPublisher,
    definition: T::Definition,
}

impl<T: Codec> Publisher<T> {
    /// Of a publisher of bytes that are those of `T`.
    pub(crate) fn new(raw: RawPublisher, definition: T::Definition) -> Self {
        Publisher { raw, definition }
    }

    /// The same publisher, silent while `gate` is closed: see [`RawPublisher::with_gate`].
    #[must_use = "it returns the changed publisher"]
    pub fn with_gate(self, gate: Gate) -> Self {
        Publisher { raw: self.raw.with_gate(gate), ..self }
    }

    /// The untyped publisher.
    pub fn raw(&self) -> &RawPublisher {
        &self.raw
    }

    /// The type's definition that is known at run time.
    pub fn definition(&self) -> &T::Definition {
        &self.definition
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.raw.topic()
    }

    /// The requested quality of service.
    pub fn qos(&self) -> Qos {
        self.raw.qos()
    }

    /// This publisher's identifier.
    pub fn gid(&self) -> Gid {
        self.raw.gid()
    }

    /// This publisher's limits: see [`RawPublisher::limits`].
    pub fn limits(&self) -> Limits {
        self.raw.limits()
    }

    /// The counters, to be read from any thread.
    pub fn counters(&self) -> Arc<PublisherCounters> {
        self.raw.counters()
    }

    /// Asserts that this publisher is alive: see [`RawPublisher::assert_liveliness`].
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions); no allocation; no syscall.
    pub fn assert_liveliness(&self) {
        self.raw.assert_liveliness();
    }

    /// Number of matching subscriptions on this host.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn subscription_count(&self) -> usize {
        self.raw.subscription_count()
    }

    /// Waits for a matching subscription: see [`RawPublisher::wait_for_subscriptions`].
    ///
    /// # Errors
    /// As there.
    pub fn wait_for_subscriptions(
        &self,
    ) -> Result<impl Future<Output = Result<(), TransportError>> + Send + use<T>, TransportError> {
        self.raw.wait_for_subscriptions()
    }
}

impl<T: Codec> AsRef<RawPublisher> for Publisher<T> {
    fn as_ref(&self) -> &RawPublisher {
        &self.raw
    }
}

impl<T: Codec> std::fmt::Debug for Publisher<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Publisher")
            .field("topic", &self.raw.topic())
            .field("gid", &self.raw.gid())
            .finish_non_exhaustive()
    }
}

/// Receives messages of type `T` from one topic. A stream of [`Sample`]s, or [`try_take`](Subscription::try_take).
///
/// May be moved between threads, but only one thread uses it at a time. Its samples may be dropped in any thread; their
/// memory returns to the publisher at this subscription's next take.
pub struct Subscription<T: Decode> {
    raw: RawSubscription,
    definition: T::Definition,
}

impl<T: Decode> Subscription<T> {
    /// Of a subscription to bytes that are those of `T`.
    pub(crate) fn new(raw: RawSubscription, definition: T::Definition) -> Self {
        Subscription { raw, definition }
    }

    /// The untyped subscription.
    pub fn raw(&self) -> &RawSubscription {
        &self.raw
    }

    /// The type's definition that is known at run time.
    pub fn definition(&self) -> &T::Definition {
        &self.definition
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.raw.topic()
    }

    /// The requested quality of service.
    pub fn qos(&self) -> Qos {
        self.raw.qos()
    }

    /// This subscription's limits.
    pub fn limits(&self) -> Limits {
        self.raw.limits()
    }

    /// The counters, to be read from any thread.
    pub fn counters(&self) -> Arc<SubscriptionCounters> {
        self.raw.counters()
    }

    /// This subscription's id in trace events.
    pub fn trace_id(&self) -> tautline_trace::ObjectId {
        self.raw.trace_id()
    }

    /// Number of matching publishers on this host.
    pub fn publisher_count(&self) -> usize {
        self.raw.publisher_count()
    }

    /// Sets whether this subscription is polled without a doorbell (by a busy-polling callback). See
    /// [`RawSubscription::set_quiet`].
    pub fn set_quiet(&self, quiet: bool) {
        self.raw.set_quiet(quiet);
    }
}
