// SPDX-License-Identifier: MIT OR Apache-2.0
//! Errors: [`TransportError`] for set-up, and one small enum per operation at run time.

use crate::names::{REQUESTS, RESPONSES};
use rustix::io::Errno;
use std::path::PathBuf;
use std::{fmt, io};
use tautline_doorbell::DoorbellError;
use tautline_msgs::cdr::{DecodeError, EncodeError};

/// Why a participant, a publisher or a subscription could not be created. Each message says what to change.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum TransportError {
    /// A file in /dev/shm could not be created or mapped.
    #[error("{} cannot be used: {source}{}", path.display(), fix(source))]
    File { path: PathBuf, source: io::Error },
    /// A file of another process was written by another version.
    #[error("{} is of another version of Tautline: use the same one in all processes of a domain; when none of them runs, the folder it is in may be removed", path.display())]
    Version { path: PathBuf },
    /// The content of another process's file cannot be read.
    #[error("{} is damaged: end its process, or remove the file", path.display())]
    Damaged { path: PathBuf },
    /// `TAUT_SCOPE` is not a valid scope.
    #[error(transparent)]
    Scope(#[from] tautline_rt::domain::ScopeError),
    /// The environment variables for tracing are invalid, or there is no memory for tracing.
    #[error(transparent)]
    Trace(#[from] tautline_trace::TraceError),
    /// A slot, a callback's bell or the sampler's role is not available.
    #[error(transparent)]
    Doorbell(#[from] DoorbellError),
    /// A forked child uses a context, publisher or subscription of its parent.
    #[error(
        "this process was forked from one that had joined domain {domain}, and owns nothing of what that made: create a context (participant) of its own after the fork"
    )]
    Forked { domain: u32 },
    /// The domain is full.
    #[error(
        "domain {domain} already has {limit} participants (contexts), its limit: put nodes together into fewer processes, or use another domain"
    )]
    Members { domain: u32, limit: usize },
    /// There is no such domain.
    #[error("domain {domain} does not exist: domains go from 0 to {max}, as in ROS 2")]
    DomainRange { domain: u32, max: u32 },
    /// The name is not a valid node name.
    #[error(
        "'{name}' cannot be a node's name: use letters, digits and '_' in a namespace that begins with '/'"
    )]
    NodeName {
        /// The name, with its namespace.
        name: String,
    },
    /// The text is not a valid enclave.
    #[error(
        "'{enclave}' cannot be an enclave: use '/', or letters, digits and '_' in a path that begins with '/'"
    )]
    Enclave { enclave: String },
    /// The name is not a valid service name.
    #[error("'{service}' cannot be a service: {reason}")]
    ServiceName { service: String, reason: &'static str },
    /// The name is not a valid topic name.
    #[error("'{topic}' cannot be a topic name: {reason}")]
    TopicName { topic: String, reason: String },
    /// The type's name or hash is not valid.
    #[error("topic '{topic}': {reason}")]
    TopicType { topic: String, reason: String },
    /// There is not enough shared memory for the samples in flight.
    #[error(
        "{}: {source}: it needs {bytes} bytes of /dev/shm for samples of {sample_bytes} bytes; make /dev/shm larger (mount -o remount,size=), or lower the depth, `Limits::held`, `Limits::loans`, `Limits::spare_bytes` or `Limits::message_bytes`",
        named(topic)
    )]
    Memory {
        topic: String,
        /// Number of bytes that are needed.
        bytes: u64,
        /// Size of one sample.
        sample_bytes: usize,
        source: io::Error,
    },
    /// A limit out of range.
    #[error("{}: {limit} = {requested} is outside 1 to {max}", named(topic))]
    LimitRange {
        topic: String,
        /// The name of the field.
        limit: &'static str,
        requested: usize,
        max: usize,
    },
    /// A duration of zero, which cannot be met.
    #[error("topic '{topic}': QoS {setting} is zero, which cannot be met; omit it if there is none")]
    ZeroDuration {
        topic: String,
        /// The field of [`Qos`](crate::Qos).
        setting: &'static str,
    },
    /// A low-priority thread could not be started.
    #[error("a thread of low priority could not be started: {0}")]
    Thread(#[source] tautline_rt::RtError),
}

impl TransportError {
    /// Whether the same operation may succeed later: a system call failed, for example at the limit of open files. Errors about the type
    /// or the owner of a file are permanent.
    pub fn is_passing(&self) -> bool {
        matches!(self, TransportError::File { source, .. } if source.raw_os_error().is_some())
    }
}

/// The name of a topic for messages; for a topic of a service's requests or responses, that of the service.
pub(crate) fn named(topic: &str) -> String {
    let service = topic.strip_prefix(REQUESTS).or_else(|| topic.strip_prefix(RESPONSES));
    match service {
        Some(service) => format!("service '{service}'"),
        None => format!("topic '{topic}'"),
    }
}

/// Why no sample could be loaned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LoanError {
    /// `Limits::loans` loans of the publisher are already in use.
    #[error("every loan of this publisher is in use: publish or drop one, or raise `Limits::loans`")]
    Exhausted,
    /// The message is longer than the type's fixed size, or than `Limits::message_bytes` of a publisher that may not grow, or
    /// than [`Limits::MAX_MESSAGE_BYTES`](crate::Limits::MAX_MESSAGE_BYTES).
    #[error(
        "the message is longer than its publisher can send: if its type has no fixed size and the message is not above 4 GiB, raise `Limits::message_bytes`, or let the publisher grow (`Limits::may_grow`)"
    )]
    TooLarge,
    /// The system has no memory for a larger segment, or for one more sample of a publisher that claims memory on use.
    #[error(
        "there is no shared memory for the message: is /dev/shm full, or address space limited (ulimit -v)? make /dev/shm larger (mount -o remount,size=), or send shorter messages"
    )]
    OutOfMemory,
    /// The publisher's node has ended.
    #[error("the node of this publisher has ended: keep the node while its publishers are in use")]
    Ended,
    /// The publisher belongs to the process that this one was forked from.
    #[error(
        "this process was forked from the one whose publisher this is: create a context of its own after the fork"
    )]
    Forked,
}

/// Why a sample was not published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PublishError {
    /// A keep-all subscription has no room: nothing was sent to any subscription.
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
}

/// Why a burst was not published to its end: see [`Publisher::publish_many`](crate::Publisher::publish_many).
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{error} (the {published} messages before that one were published)")]
pub struct BurstError<E = PublishError> {
    /// How many messages were published: those before the one that was not.
    pub published: usize,
    /// Why the next one was not.
    pub error: E,
}

/// What was not sent, and why: the unchanged loan of a message, a request or a response. Nothing was sent to any
/// endpoint.
pub struct SendError<L, E = PublishError> {
    /// Why.
    pub error: E,
    /// The loan: send it again or drop it.
    pub loan: L,
}

impl<L, E> SendError<L, E> {
    pub(crate) fn map<M>(self, change: impl FnOnce(L) -> M) -> SendError<M, E> {
        SendError { error: self.error, loan: change(self.loan) }
    }
}

tautline_rt::debug_fields!([L, E: fmt::Debug] SendError<L, E>, |this| error = this.error);

impl<L, E: fmt::Display> fmt::Display for SendError<L, E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.error.fmt(f)
    }
}

impl<L, E: std::error::Error> std::error::Error for SendError<L, E> {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.error.source()
    }
}

impl<L> From<SendError<L>> for PublishError {
    fn from(unsent: SendError<L>) -> Self {
        unsent.error
    }
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
    /// This subscription holds as many samples as its `Limits::held` allows.
    #[error("this subscription holds its maximum number of samples: drop one, or raise `Limits::held`")]
    TooManyHeld,
    /// The bytes are not a message of this type.
    #[error("the sample is not a valid message: {0}")]
    Invalid(DecodeError),
}

/// The remedy for a system error at a file in /dev/shm; empty for other errors, which state it themselves.
fn fix(error: &io::Error) -> &'static str {
    match Errno::from_io_error(error) {
        None => "",
        Some(Errno::ROFS) => {
            "; mount -o remount,rw /dev/shm makes it writable, and so does --ipc=host or --tmpfs /dev/shm for a container"
        }
        Some(Errno::NOSPC) => {
            "; mount -o remount,size=4G /dev/shm makes room, and so does --shm-size for a container"
        }
        Some(Errno::MFILE | Errno::NFILE) => "; raise the limit of open files (ulimit -n)",
        Some(Errno::ACCESS | Errno::PERM) => "; chmod 1777 /dev/shm lets every user make files there",
        Some(_) => "; check that /dev/shm exists, and is a tmpfs",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_refusal_of_the_system_has_one_fix() {
        let of =
            |source: io::Error| TransportError::File { path: "/dev/shm/taut_0_0".into(), source }.to_string();
        let expected = "/dev/shm/taut_0_0 cannot be used: Read-only file system (os error 30); mount -o remount,rw /dev/shm makes it \
                        writable, and so does --ipc=host or --tmpfs /dev/shm for a container";
        assert_eq!(of(Errno::ROFS.into()), expected);
        assert!(of(Errno::NOSPC.into()).contains("os error 28); mount -o remount,size="));
        assert!(of(Errno::MFILE.into()).ends_with("os error 24); raise the limit of open files (ulimit -n)"));
        assert!(
            of(Errno::ACCESS.into())
                .ends_with("os error 13); chmod 1777 /dev/shm lets every user make files there")
        );
        assert!(of(io::Error::other("it belongs to user 7: remove it")).ends_with("user 7: remove it"));
    }
}
