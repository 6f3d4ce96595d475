// SPDX-License-Identifier: MIT OR Apache-2.0
//! What can go wrong: [`TransportError`] while setting up, one small enum per operation while running.

use std::io;
use std::path::PathBuf;
use tautline_msgs::cdr::{DecodeError, EncodeError};

/// Why a participant, a topic, a publisher or a subscription could not be made. Each says what to change.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TransportError {
    /// The file of the doorbell could not be made or mapped.
    #[error("the doorbell {} cannot be used: {source}; check that /dev/shm exists, is writable and is not full, and that the process is not at its limit of open files (ulimit -n)", path.display())]
    Arena {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file of another process's doorbell is not what this version makes.
    #[error("the doorbell {} is of another version of Tautline: use the same one in all processes", path.display())]
    ArenaVersion {
        /// The file.
        path: PathBuf,
    },
    /// What the environment says about tracing is not understood, or there is no memory for it.
    #[error(transparent)]
    Trace(#[from] tautline_trace::TraceError),
    /// A file that says what the domain has, or when that changed, could not be made or mapped.
    #[error("{} cannot be used: {source}; check that /dev/shm is writable and not full; if the file is another user's, remove it", path.display())]
    Graph {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A context has no slot left.
    #[error(
        "this context already has {limit} subscriptions, publishers, timers and guard conditions, its limit; make a second Context for more"
    )]
    Slots {
        /// The limit.
        limit: usize,
    },
    /// All bells of callback threads are in use.
    #[error(
        "this context already has {limit} callback threads that publishers wake directly, its limit; let others be woken by the sampler, or make a second Context for more"
    )]
    ThreadBells {
        /// The limit.
        limit: usize,
    },
    /// iceoryx2 refused to make its node.
    #[error(
        "no iceoryx2 node in domain {domain}: {reason}; check that /tmp/tautline_<uid> and /dev/shm are writable; files that another version left there (/dev/shm/taut_{domain}_*) may be removed when no node runs"
    )]
    Node {
        /// The domain.
        domain: u32,
        /// iceoryx2's word for it.
        reason: String,
    },
    /// A participant has one sampler.
    #[error("this participant has a sampler already: use that one, or drop it first")]
    SecondSampler,
    /// There is no such domain.
    #[error("domain {domain} does not exist: domains go from 0 to {max}, as in ROS 2")]
    DomainRange {
        /// The domain.
        domain: u32,
        /// The greatest one.
        max: u32,
    },
    /// The name cannot be a node's.
    #[error(
        "'{name}' cannot be a node's name: it is letters, digits and '_' in a namespace that begins with '/'"
    )]
    NodeName {
        /// The name, with its namespace.
        name: String,
    },
    /// The name cannot be a service's, or the type not its type.
    #[error("'{service}' cannot be a service: {reason}")]
    ServiceName {
        /// The name.
        service: String,
        /// Why not.
        reason: &'static str,
    },
    /// The name cannot be a topic's.
    #[error("'{topic}' cannot be a topic name: {reason}")]
    TopicName {
        /// The name.
        topic: String,
        /// Why not.
        reason: String,
    },
    /// The type's name or hash cannot be one.
    #[error("topic '{topic}': {reason}")]
    TopicType {
        /// The topic.
        topic: String,
        /// Why not.
        reason: String,
    },
    /// The topic exists with another type.
    #[error(
        "{} carries '{existing}', not '{requested}': rename one of them, or use the same type",
        named(topic)
    )]
    TypeMismatch {
        /// The topic.
        topic: String,
        /// The type it has, with its size and hash where they are known.
        existing: String,
        /// The type asked for, with its size and hash where they are known.
        requested: String,
    },
    /// A limit of the topic is below what is asked for.
    #[error("{} was opened with {limit} = {existing}, but {requested} {}: raise `Limits::{limit}` where it is opened first", named(topic), if *.requested == 1 { "is needed" } else { "are needed" })]
    Limit {
        /// The topic.
        topic: String,
        /// Name of the field of [`Limits`](crate::Limits).
        limit: &'static str,
        /// What the topic has.
        existing: usize,
        /// What would be needed.
        requested: usize,
    },
    /// A limit outside what can be set.
    #[error("{}: {limit} = {requested} is outside 1 to {max}", named(topic))]
    LimitRange {
        /// The topic.
        topic: String,
        /// Name of the field.
        limit: &'static str,
        /// The value asked for.
        requested: usize,
        /// The greatest value.
        max: usize,
    },
    /// A time that nothing can keep.
    #[error("topic '{topic}': QoS {setting} is zero, which nothing can keep; leave it out if there is none")]
    ZeroDuration {
        /// The topic.
        topic: String,
        /// The field of [`Qos`](crate::Qos).
        setting: &'static str,
    },
    /// iceoryx2 refused.
    #[error(
        "{}: {what} failed in iceoryx2: {reason}; check that /dev/shm and /tmp/tautline_<uid> are writable and not full, that the process is not at its limit of open files (ulimit -n), and that all processes of the domain have the same version of Tautline",
        named(topic)
    )]
    Iceoryx {
        /// The topic.
        topic: String,
        /// Which step.
        what: &'static str,
        /// iceoryx2's word for it.
        reason: String,
    },
    /// A low-priority thread could not be started.
    #[error("a thread of low priority could not be started: {0}")]
    Janitor(#[source] tautline_rt::RtError),
}

/// What a topic is called: that of a service's requests is the service.
fn named(topic: &str) -> String {
    match topic.strip_prefix(crate::topics::REQUESTS) {
        Some(service) => format!("service '{service}'"),
        None => format!("topic '{topic}'"),
    }
}

/// Why no sample could be loaned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LoanError {
    /// As many loans as the topic's `Limits::loans` are out already.
    #[error("every loan of this publisher is in use: publish or drop one, or raise `Limits::loans`")]
    Exhausted,
    /// The message is longer than the topic's fixed size, or than `Limits::message_bytes` of a publisher that may not grow, or
    /// than [`Limits::MAX_MESSAGE_BYTES`](crate::Limits::MAX_MESSAGE_BYTES).
    #[error(
        "the message is longer than its publisher can send: if its type has no fixed size and the message is not above 4 GiB, raise `Limits::message_bytes`, or let the publisher grow (`Limits::may_grow`)"
    )]
    TooLarge,
    /// iceoryx2 has no memory left for this publisher, or the system none for a larger segment.
    #[error(
        "the publisher's shared memory is exhausted: is /dev/shm full, or address space limited (ulimit -v)?"
    )]
    OutOfMemory,
}

/// Why a sample was not published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PublishError {
    /// A keep-all subscription has no room: nothing was sent to anybody.
    #[error(
        "a keep-all subscription's queue is full: publish again when it has taken, or await `publish_when_ready`"
    )]
    Full,
    /// No sample could be loaned for the message.
    #[error(transparent)]
    Loan(#[from] LoanError),
    /// The message cannot be written: a string or sequence is longer than its bound.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// iceoryx2 could not deliver to every subscription; those missed count it as lost.
    #[error(
        "the sample could not be delivered to every subscription, and those that it missed count it as lost; is the process at its limit of open files (ulimit -n), or /dev/shm full? publish the next one as ever: it goes to all that can be reached"
    )]
    Incomplete,
}

/// Why the CDR of a message was not published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PublishCdrError {
    /// The bytes are not a message of the topic's type. Nothing was sent.
    #[error("not published: {0}")]
    Invalid(#[from] DecodeError),
    /// It was not published.
    #[error(transparent)]
    Publish(#[from] PublishError),
}

impl From<LoanError> for PublishCdrError {
    fn from(error: LoanError) -> Self {
        PublishCdrError::Publish(error.into())
    }
}

/// Why nothing was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TakeError {
    /// This subscription holds as many samples as the topic's `Limits::held` allows.
    #[error("this subscription holds as many samples as its topic allows: drop one, or raise `Limits::held`")]
    TooManyHeld,
    /// The bytes are not a message of this type.
    #[error("the sample is not a valid message: {0}")]
    Invalid(DecodeError),
    /// A publisher's memory could not be mapped.
    #[error(
        "a publisher's shared memory could not be mapped: its samples do not arrive; is the process at its limit of open files?"
    )]
    Connection,
}
