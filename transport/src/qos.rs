// SPDX-License-Identifier: MIT OR Apache-2.0
//! Quality of service and the limits of a topic: plain data.

use crate::error::TransportError;
use std::time::Duration;

/// What happens to samples on their way. Locally both keep their promise; the network tells them apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Reliability {
    /// Samples may be dropped on the network.
    BestEffort,
    /// Samples are sent again until they arrive.
    #[default]
    Reliable,
}

/// Whether a late joiner gets what was published before it came.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Durability {
    /// No.
    #[default]
    Volatile,
    /// The last `depth` samples of each publisher that lives, even of one that stays silent.
    TransientLocal,
}

/// What happens when a subscription is slower than its publishers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum History {
    /// The newest `depth` samples stay; what is overwritten is counted as lost, at that subscription alone.
    #[default]
    KeepLast,
    /// Nothing is overwritten: with `depth` samples waiting, publish() returns `Full` at once. Both ends must keep all.
    ///
    /// A sample that is being published while a subscription joins may reach it before the publisher knows of it: that one is not in
    /// the publisher's count of what waits there, so it alone may be overwritten by the `depth` samples after it, and is not counted
    /// as lost. What is published later is safe.
    KeepAll,
}

/// How a publisher shows that it is alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Liveliness {
    /// By living: it is alive as long as its process is.
    #[default]
    Automatic,
    /// By publishing, or by [asserting it](crate::RawPublisher::assert_liveliness), at least once in each lease.
    ManualByTopic,
}

/// Quality of service of a publisher or a subscription. A publisher offers it, a subscription requests it: see
/// [`Qos::incompatibility`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Qos {
    /// See [`History`].
    pub history: History,
    /// Queue length in samples, per publisher; with keep-all the bound of the queue.
    pub depth: usize,
    /// See [`Reliability`].
    pub reliability: Reliability,
    /// See [`Durability`].
    pub durability: Durability,
    /// Longest time between two samples; what comes later is told to who [watches](crate::SubscriptionMonitor).
    pub deadline: Option<Duration>,
    /// Age at which a sample is no longer delivered, counted from its publication on this host. It is the publisher's: a
    /// subscription's is not looked at, as in ROS 2.
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
        Qos { history: History::KeepAll, ..Qos::keep_last(bound) }
    }

    /// The same with late joiners served.
    #[must_use]
    pub const fn transient_local(mut self) -> Self {
        self.durability = Durability::TransientLocal;
        self
    }

    /// The same, best effort.
    #[must_use]
    pub const fn best_effort(mut self) -> Self {
        self.reliability = Reliability::BestEffort;
        self
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

/// Limits of a topic, fixed by whoever opens it first; exceeding one is an error that names it.
///
/// They reserve address space, not memory: a publisher reserves
/// `depth + (subscribers + publishers) x held + loans` samples, and a page becomes resident when a sample in it is first
/// written ([`topic_memory`](crate::topic_memory) computes both). Each publisher and subscription that are connected also need
/// open files: one in the publisher's process, two in the subscription's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Limits {
    /// Most publishers of the topic. At most 64; 8 by default.
    pub publishers: usize,
    /// Most subscriptions of the topic. At most 128; 16 by default.
    pub subscribers: usize,
    /// Greatest depth that a subscription can ask for. 100 by default, or the first opener's depth where that is more.
    pub depth: usize,
    /// Most samples that a subscription can hold at once. 4 by default.
    pub held: usize,
    /// Most loans that a publisher can have out at once. 4 by default.
    pub loans: usize,
    /// The largest message in bytes of CDR that a publisher sends without growing its memory, for types whose size is not
    /// fixed. A larger one is published too, but takes a new segment: not real-time, counted, and said once in the log.
    /// Each publisher has its own. 4,096 by default.
    pub message_bytes: usize,
    /// Whether a publisher of a type without a fixed size takes a larger segment for a message longer than `message_bytes`. If
    /// not, such a message is refused ([`LoanError::TooLarge`](crate::LoanError::TooLarge)), and iceoryx2's books take a
    /// megabyte less. True by default.
    pub may_grow: bool,
}

impl Limits {
    /// Greatest value of [`Limits::publishers`].
    pub const MAX_PUBLISHERS: usize = 64;
    /// Greatest value of [`Limits::subscribers`].
    pub const MAX_SUBSCRIBERS: usize = 128;
    /// Greatest value of [`Limits::depth`].
    pub const MAX_DEPTH: usize = 65_536;
    /// Greatest value of [`Limits::held`] and [`Limits::loans`].
    pub const MAX_HELD: usize = 4_096;
    /// Greatest value of [`Limits::message_bytes`], and largest message: 4 GiB, what CDR's 32-bit lengths can say.
    pub const MAX_MESSAGE_BYTES: usize = 1 << 32;

    pub(crate) fn check(&self, topic: &str) -> Result<(), TransportError> {
        in_range(topic, "publishers", self.publishers, Self::MAX_PUBLISHERS)?;
        in_range(topic, "subscribers", self.subscribers, Self::MAX_SUBSCRIBERS)?;
        in_range(topic, "depth", self.depth, Self::MAX_DEPTH)?;
        in_range(topic, "held", self.held, Self::MAX_HELD)?;
        in_range(topic, "loans", self.loans, Self::MAX_HELD)?;
        in_range(topic, "message_bytes", self.message_bytes, Self::MAX_MESSAGE_BYTES)
    }
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            publishers: 8,
            subscribers: 16,
            depth: 100,
            held: 4,
            loans: 4,
            message_bytes: 4096,
            may_grow: true,
        }
    }
}

/// 584 years at most.
pub(crate) fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

fn in_range(topic: &str, limit: &'static str, requested: usize, max: usize) -> Result<(), TransportError> {
    if (1..=max).contains(&requested) {
        return Ok(());
    }
    Err(TransportError::LimitRange { topic: topic.into(), limit, requested, max })
}
