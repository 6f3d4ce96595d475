// SPDX-License-Identifier: MIT OR Apache-2.0
//! Quality of service and the limits of a topic: plain data.

use crate::error::TransportError;
use std::time::Duration;

/// Whether samples may be lost on the network. On one host both policies behave alike.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Reliability {
    /// Samples may be dropped on the network.
    BestEffort,
    /// Samples are sent again until they arrive.
    #[default]
    Reliable,
}

/// Whether a late joiner gets samples that were published before it joined.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Durability {
    /// It does not.
    #[default]
    Volatile,
    /// It gets the last `depth` samples of each live publisher, even of a silent one.
    TransientLocal,
}

/// What happens when a subscription is slower than its publishers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum History {
    /// The newest `depth` samples are kept; overwritten samples are counted as lost, at this subscription
    /// only.
    #[default]
    KeepLast,
    /// Nothing is overwritten: with `depth` samples queued, publish() returns `Full` at once. Both endpoints must keep
    /// all.
    KeepAll,
}

/// How a publisher shows that it is alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Liveliness {
    /// Automatically: it is alive as long as its process is.
    #[default]
    Automatic,
    /// By publishing, or by [asserting it](crate::RawPublisher::assert_liveliness), at least once in each lease.
    ManualByTopic,
}

/// Quality of service of a publisher or a subscription. A publisher offers it, a subscription requests it: see
/// [`Qos::incompatibility`].
///
/// ```
/// # use tautline_transport::{Durability, Qos};
/// const LATCHED: Qos = Qos::keep_last(1).transient_local();
/// assert_eq!((LATCHED.depth, LATCHED.durability), (1, Durability::TransientLocal));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[must_use = "it returns the changed QoS"]
pub struct Qos {
    /// See [`History`].
    pub history: History,
    /// Queue length in samples, per publisher; with keep-all the bound of the queue. 1 to [`Limits::MAX_DEPTH`].
    pub depth: usize,
    /// See [`Reliability`].
    pub reliability: Reliability,
    /// See [`Durability`].
    pub durability: Durability,
    /// Longest time between two samples; a later sample is reported to a [monitor](crate::SubscriptionMonitor).
    pub deadline: Option<Duration>,
    /// Age at which a sample is no longer delivered, counted from its publication on this host. Only the publisher's
    /// value is used; a subscription's is ignored, as in ROS 2.
    pub lifespan: Option<Duration>,
    /// See [`Liveliness`].
    pub liveliness: Liveliness,
    /// Longest time between two signs of life of a publisher whose liveliness is manual.
    pub liveliness_lease_duration: Option<Duration>,
}

impl Qos {
    /// Keep-last with this depth, reliable, volatile.
    pub const fn keep_last(depth: usize) -> Self {
        Qos {
            history: History::KeepLast,
            depth,
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            deadline: None,
            lifespan: None,
            liveliness: Liveliness::Automatic,
            liveliness_lease_duration: None,
        }
    }

    /// Keep-all with this bound, reliable, volatile.
    pub const fn keep_all(bound: usize) -> Self {
        Qos::keep_last(bound).history(History::KeepAll)
    }

    /// ROS 2's profile for sensors: keep last 5, best effort, volatile.
    pub const fn sensor_data() -> Self {
        Qos::keep_last(5).best_effort()
    }

    /// ROS 2's profile for services: keep last 10, reliable, volatile.
    pub const fn services_default() -> Self {
        Qos::keep_last(10)
    }

    /// ROS 2's profile for parameter services: keep last 1000, reliable, volatile.
    pub const fn parameters() -> Self {
        Qos::keep_last(1000)
    }

    /// ROS 2's profile for `/parameter_events`: keep last 1000, reliable, volatile.
    pub const fn parameter_events() -> Self {
        Qos::keep_last(1000)
    }

    /// Sets the history policy.
    pub const fn history(self, history: History) -> Self {
        Qos { history, ..self }
    }

    /// Sets the depth, or the bound of keep-all.
    pub const fn depth(self, depth: usize) -> Self {
        Qos { depth, ..self }
    }

    /// Sets the reliability policy.
    pub const fn reliability(self, reliability: Reliability) -> Self {
        Qos { reliability, ..self }
    }

    /// The network retransmits lost samples.
    pub const fn reliable(self) -> Self {
        self.reliability(Reliability::Reliable)
    }

    /// The network may lose samples.
    pub const fn best_effort(self) -> Self {
        self.reliability(Reliability::BestEffort)
    }

    /// Sets the durability policy.
    pub const fn durability(self, durability: Durability) -> Self {
        Qos { durability, ..self }
    }

    /// Late joiners get what is published after they joined.
    pub const fn volatile(self) -> Self {
        self.durability(Durability::Volatile)
    }

    /// Late joiners get the last `depth` samples as well.
    pub const fn transient_local(self) -> Self {
        self.durability(Durability::TransientLocal)
    }

    /// Sets the deadline. Zero is refused when an endpoint is created.
    pub const fn deadline(self, deadline: Duration) -> Self {
        Qos { deadline: Some(deadline), ..self }
    }

    /// Sets the lifespan. Zero is refused when an endpoint is created.
    pub const fn lifespan(self, lifespan: Duration) -> Self {
        Qos { lifespan: Some(lifespan), ..self }
    }

    /// Sets the liveliness policy.
    pub const fn liveliness(self, liveliness: Liveliness) -> Self {
        Qos { liveliness, ..self }
    }

    /// Sets the lease duration of a publisher whose liveliness is manual. Zero is refused when an endpoint is
    /// created.
    pub const fn liveliness_lease_duration(self, lease: Duration) -> Self {
        Qos { liveliness_lease_duration: Some(lease), ..self }
    }

    pub(crate) fn check(&self, topic: &str) -> Result<(), TransportError> {
        for (setting, duration) in [
            ("deadline", self.deadline),
            ("lifespan", self.lifespan),
            ("liveliness_lease_duration", self.liveliness_lease_duration),
        ] {
            if duration == Some(Duration::ZERO) {
                return Err(TransportError::ZeroDuration { topic: topic.into(), setting });
            }
        }
        in_range(topic, "depth", self.depth, Limits::MAX_DEPTH)
    }
}

impl Default for Qos {
    /// ROS 2's default: keep last 10, reliable, volatile.
    fn default() -> Self {
        Qos::keep_last(10)
    }
}

/// When the memory of a publisher's samples is claimed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Claim {
    /// When the publisher is created, and when a subscription joins: for the maximum number of samples in
    /// flight, each of [`Limits::message_bytes`]. Loaning, publishing and taking then cause no page fault and
    /// no system call.
    #[default]
    Ahead,
    /// When it is first needed: a loan may make system calls and cause page faults; before that no memory is used. Publishing takes a lock
    /// for that, which the janitor may hold while it maps memory; the janitor inherits the publishing thread's priority meanwhile. For
    /// messages that are sent seldom, and for threads that need no bound.
    OnUse,
}

/// The limits of a publisher or a subscription. Each endpoint has its own limits, independent of other
/// endpoints.
///
/// A publisher has memory for `depth + kept + held + loans` samples and for spare ones: `kept` is its own depth if it is transient local,
/// `depth` the greatest of `kept` and its subscriptions' depths, `held` the sum of their limits. See [`topic_memory`](crate::topic_memory).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Limits {
    /// Of a subscription: maximum number of samples that it can hold at once. 4 by default. Of a client: of responses, 8 at least, besides
    /// those that arrive for pending requests.
    pub held: usize,
    /// Of a publisher: maximum number of loans at once. 4 by default.
    pub loans: usize,
    /// Of a publisher of a type whose size is not fixed: the largest message in bytes of CDR that it sends without growing its
    /// memory. A larger message is published, too, but needs a new segment: this is not real-time, is counted, and logged once.
    /// 4,096 by default.
    pub message_bytes: usize,
    /// Whether a publisher of a type without a fixed size claims a larger segment for a message longer than `message_bytes`.
    /// If not, such a message is refused ([`LoanError::TooLarge`](crate::LoanError::TooLarge)). True by default.
    pub may_grow: bool,
    /// When a publisher's memory is claimed. Ahead by default.
    pub claim: Claim,
    /// Of a publisher whose memory is claimed ahead, with samples from 16 KiB: bytes at most for spare samples, so that a sample has left
    /// the caches of the core that read it before it is written again. With the samples in flight at most four second-level caches, or a
    /// quarter of the third-level cache if that is less; none if a quarter is at most two second-level caches. 8 MiB by default; 0: none.
    pub spare_bytes: usize,
}

impl Limits {
    /// Maximum of [`Qos::depth`].
    pub const MAX_DEPTH: usize = 65_536;
    /// Maximum of [`Limits::held`] and [`Limits::loans`].
    pub const MAX_HELD: usize = 4_096;
    /// Maximum of [`Limits::message_bytes`], and largest message: 4 GiB less 8 bytes, the limit of CDR's 32-bit lengths.
    pub const MAX_MESSAGE_BYTES: usize = u32::MAX as usize & !7;

    pub(crate) fn check(&self, topic: &str) -> Result<(), TransportError> {
        in_range(topic, "held", self.held, Self::MAX_HELD)?;
        in_range(topic, "loans", self.loans, Self::MAX_HELD)?;
        in_range(topic, "message_bytes", self.message_bytes, Self::MAX_MESSAGE_BYTES)
    }
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            held: 4,
            loans: 4,
            message_bytes: 4096,
            may_grow: true,
            claim: Claim::Ahead,
            spare_bytes: 8 << 20,
        }
    }
}

fn in_range(topic: &str, limit: &'static str, requested: usize, max: usize) -> Result<(), TransportError> {
    if (1..=max).contains(&requested) {
        return Ok(());
    }
    Err(TransportError::LimitRange { topic: topic.into(), limit, requested, max })
}
