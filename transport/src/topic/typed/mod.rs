// SPDX-License-Identifier: MIT OR Apache-2.0
//! Typed publishers and subscriptions, and how messages are written and read. A Rust type is its own codec, in place in shared memory;
//! the layer above has other codecs, for types that are known only at run time.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

pub(crate) mod hot;

use crate::error::{PublishCdrError, PublishError, TransportError};
use crate::graph::topic_type::TopicType;
use crate::memory::header::Gid;
use crate::qos::{Limits, Qos};
use crate::topic::participant::Participant;
use crate::topic::publisher::RawPublisher;
use crate::topic::publisher::counters::PublisherCounters;
use crate::topic::publisher::gate::Gate;
use crate::topic::subscription::{RawSubscription, SubscriptionCounters};
use std::ops::DerefMut;
use std::sync::Arc;
use tautline_msgs::cdr::{DecodeError, DecodeFault, EncodeError, Endian, FieldPath};
use tautline_msgs::{Body, Message, split_header};

/// Publishes messages of type `T` on one topic: written in place after [`loan`](Publisher::loan) or, for variable sizes,
/// [`loan_with`](Publisher::loan_with); or owned messages, with [`publish`](Publisher::publish).
///
/// May be moved between threads, but only one thread uses it at a time.
pub struct Publisher<T: Codec> {
    raw: RawPublisher,
    definition: T::Definition,
}

impl Gate {
    /// The same publisher, silent while this gate is closed: see [`RawPublisher::with_gate`](crate::RawPublisher::with_gate).
    #[must_use = "it returns the changed publisher"]
    pub fn guard<T: Codec>(&self, publisher: Publisher<T>) -> Publisher<T> {
        Publisher { raw: publisher.raw.with_gate(self.clone()), ..publisher }
    }
}

impl<T: Codec> Publisher<T> {
    /// Wraps a publisher of bytes that are messages of type `T`.
    pub(crate) fn new(raw: RawPublisher, definition: T::Definition) -> Self {
        Publisher { raw, definition }
    }

    /// The type's definition that is known at run time.
    pub fn definition(&self) -> &T::Definition {
        &self.definition
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.raw.topic()
    }

    /// The offered quality of service.
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

tautline_rt::debug_fields!([T: Codec] Publisher<T>, |this| topic = this.raw.topic(), gid = this.raw.gid());

/// Receives messages of type `T` from one topic. A stream of [`Sample`](crate::Sample)s, or [`try_take`](Subscription::try_take).
///
/// May be moved between threads, but only one thread uses it at a time. Its samples may be dropped in any thread; their
/// memory returns to the publisher at this subscription's next take.
pub struct Subscription<T: Decode> {
    raw: RawSubscription,
    definition: T::Definition,
}

impl<T: Decode> Subscription<T> {
    /// Wraps a subscription to bytes that are messages of type `T`.
    pub(crate) fn new(raw: RawSubscription, definition: T::Definition) -> Self {
        Subscription { raw, definition }
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

impl<T: Decode> AsRef<RawSubscription> for Subscription<T> {
    fn as_ref(&self) -> &RawSubscription {
        &self.raw
    }
}

impl Participant {
    /// Creates a publisher of `topic`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid QoS.
    pub fn create_publisher<T: Message>(
        &self,
        topic: &str,
        qos: Qos,
        limits: Limits,
    ) -> Result<Publisher<T>, TransportError> {
        self.create_publisher_of(topic, &TopicType::of::<T>(), (), qos, limits)
    }

    /// The same for callers that know more about the type than `T` states: the hash of a type that is only defined in Rust, or the
    /// definition of a type that is known at run time.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`create_publisher`](Self::create_publisher).
    pub fn create_publisher_of<T: Codec>(
        &self,
        topic: &str,
        topic_type: &TopicType,
        definition: T::Definition,
        qos: Qos,
        limits: Limits,
    ) -> Result<Publisher<T>, TransportError> {
        Ok(Publisher::new(self.create_raw_publisher(topic, topic_type, qos, limits)?, definition))
    }

    /// Creates a subscription of `topic`, a fully qualified name. What is published from now on is queued.
    ///
    /// # Real-time
    /// Setup only. Waits up to 100 ms for the processes of existing publishers, because one of them may be
    /// stopped.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid QoS.
    pub fn create_subscription<T: Message>(
        &self,
        topic: &str,
        qos: Qos,
        limits: Limits,
    ) -> Result<Subscription<T>, TransportError> {
        self.create_subscription_of(topic, &TopicType::of::<T>(), (), qos, limits)
    }

    /// The same for callers that know more about the type than `T` states, like
    /// [`create_publisher_of`](Self::create_publisher_of).
    ///
    /// # Real-time and errors
    /// As [`create_subscription`](Self::create_subscription).
    pub fn create_subscription_of<T: Decode>(
        &self,
        topic: &str,
        topic_type: &TopicType,
        definition: T::Definition,
        qos: Qos,
        limits: Limits,
    ) -> Result<Subscription<T>, TransportError> {
        Ok(Subscription::new(self.create_raw_subscription(topic, topic_type, qos, limits)?, definition))
    }
}

/// How the samples of a topic are read. Every [`Message`] is read in place, as its own [`view`](Message::view) does.
///
/// # Real-time
/// For a Rust type wait-free, without allocation except in [`owned`](Decode::owned). Other codecs check nothing before a message
/// is copied, and allocate for each copy.
pub trait Decode: Sized + 'static {
    /// What must be known of the type at run time: nothing of a Rust type. It is cloned for each sample, without allocation.
    type Definition: Clone + Send + Sync + Unpin + 'static;
    /// What reads a sample in place.
    type View<'a>: Copy + Send + Sync;
    /// What is copied out of a sample.
    type Owned;

    /// Checks a body as far as a take checks it, and returns the view that reads it in place.
    ///
    /// # Errors
    /// [`DecodeError`]: it is no message.
    fn view(body: Body<'_>) -> Result<Self::View<'_>, DecodeError>;

    /// The same view for a shorter time.
    #[doc(hidden)]
    fn shorten<'short, 'long: 'short>(view: Self::View<'long>) -> Self::View<'short>;

    /// Copies what a view reads.
    fn owned(definition: &Self::Definition, view: Self::View<'_>) -> Self::Owned;
}

/// How the messages of a topic are written, in addition to how they are read.
///
/// # Real-time
/// For a Rust type wait-free, without allocation; other codecs allocate for each message.
pub trait Codec: Decode {
    /// Why a value is no message.
    type Invalid;
    /// Why a value was not published.
    type Error: From<PublishError> + From<Self::Invalid>;
    /// Why the CDR of a message was not published.
    type CdrError;

    /// Writes the message into the memory that `loan` returns for its length in bytes.
    ///
    /// # Errors
    /// Those of `loan`; what `invalid` makes of [`Invalid`](Self::Invalid).
    fn encode_into<L: DerefMut<Target = [u8]>, E>(
        &self,
        definition: &Self::Definition,
        loan: impl FnOnce(usize) -> Result<L, E>,
        invalid: impl FnOnce(Self::Invalid) -> E,
    ) -> Result<L, E>;

    /// [`Publisher::publish_raw`].
    ///
    /// # Errors
    /// As there.
    fn publish_cdr(publisher: &Publisher<Self>, cdr: &[u8]) -> Result<(), Self::CdrError>;
}

impl<T: Message> Decode for T {
    type Definition = ();
    type View<'a> = <T as Message>::View<'a>;
    type Owned = T;

    fn view(body: Body<'_>) -> Result<Self::View<'_>, DecodeError> {
        <T as Message>::view(body)
    }

    fn shorten<'short, 'long: 'short>(view: Self::View<'long>) -> Self::View<'short> {
        <T as Message>::shorten(view)
    }

    fn owned((): &(), view: Self::View<'_>) -> T {
        <T as Message>::owned(view)
    }
}

impl<T: Message> Codec for T {
    type Invalid = EncodeError;
    type Error = PublishError;
    type CdrError = PublishCdrError;

    fn encode_into<L: DerefMut<Target = [u8]>, E>(
        &self,
        (): &(),
        loan: impl FnOnce(usize) -> Result<L, E>,
        invalid: impl FnOnce(EncodeError) -> E,
    ) -> Result<L, E> {
        let mut loan = loan(self.cdr_len())?;
        self.encode(&mut loan).map_err(invalid)?;
        Ok(loan)
    }

    /// The bytes are copied into a loan once and checked there as any sample is when it is taken. Big-endian ones are decoded and
    /// written anew.
    fn publish_cdr(publisher: &Publisher<T>, cdr: &[u8]) -> Result<(), PublishCdrError> {
        let (endian, body) = split_header(cdr).map_err(whole::<T>)?;
        if endian == Endian::Big {
            return Ok(publisher.publish(&T::decode(body, endian)?)?);
        }
        // Other middleware may pad messages of a fixed size.
        let padding = T::FIXED_LEN.map_or(0, |len| body.len().saturating_sub(len));
        if padding > MAX_PADDING {
            return Err(whole::<T>(DecodeFault::Trailing { len: padding, most: MAX_PADDING }).into());
        }
        let body = body.get(..body.len() - padding).unwrap_or_default();
        let mut loan = publisher.raw.loan(body.len())?;
        tautline_rt::copy_to_shared(&mut loan, body);
        let memory = Body::new(loan.payload(), body.len()).map_err(whole::<T>)?;
        <T as Message>::view(memory)?;
        Ok(loan.publish().map_err(PublishError::from)?)
    }
}

/// The maximum number of bytes that other middleware appends to a message of a fixed size.
const MAX_PADDING: usize = 8;

fn whole<T: Message>(fault: DecodeFault) -> DecodeError {
    DecodeError { type_name: T::TYPE_NAME, path: FieldPath::EMPTY, offset: 0, fault }
}
