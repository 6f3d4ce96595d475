// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::values::ParameterError;
use std::path::PathBuf;
use std::time::Duration;
use tautline_executor::ExecutorError;
use tautline_msgs::cdr::{DecodeError, EncodeError, WriteError};
use tautline_rt::RtError;
use tautline_system::SystemError;
use tautline_transport::{
    BurstError, LoanError, PublishCdrError, PublishError, SendError, ServiceError, TakeError, TransportError,
};

/// Errors of setting up a node and of publishing. Each message names the object, the limit and the fix.
#[derive(thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum Error {
    /// A node's, namespace's or topic's name breaks ROS 2's rules.
    #[error("'{name}' is not a valid {kind}: {reason}")]
    Name { name: String, kind: &'static str, reason: String },
    /// An invalid remapping rule.
    #[error(
        "'{rule}' is not a remapping rule: {reason}; write from:=to, [node:]__node:=name or [node:]__ns:=/namespace"
    )]
    Remap { rule: String, reason: String },
    /// An argument of the command line.
    #[error("'{argument}' is not understood: {reason}")]
    Argument {
        /// The argument, with its value.
        argument: String,
        reason: String,
    },
    /// A parameter was not declared, read or set, or a parameter file is not understood.
    #[error(transparent)]
    Parameter(Box<ParameterError>),
    /// A system file or an environment variable that cannot be used, or load that is not admitted.
    #[error(transparent)]
    System(#[from] SystemError),
    /// The awaited object ended with its node.
    #[error("the node was dropped, and its timers with it: keep the node as long as they are used")]
    NodeEnded,
    /// A timer with a period of zero, which would always be due.
    #[error("a timer cannot have a period of zero: give it the time between two releases")]
    ZeroPeriod,
    /// A timer whose period is so short that the sampler would have no time for anything else.
    #[error("a timer cannot have a period of {period:?}: the shortest is {min:?}")]
    ShortPeriod { period: Duration, min: Duration },
    /// A clock of another type was used as a ROS clock.
    #[error("the clock is not of type RosTime: only that one follows /clock and jumps")]
    ClockTypeNotRosTime,
    /// Too many timers, sleeps and transform listeners on one node's ROS clock.
    #[error(
        "{max} timers, sleeps and transform listeners are on this node's ROS clock already: use another node, or a wall timer"
    )]
    ClockUsers { max: usize },
    /// A callback was requested by name, but the context was built without a system file.
    #[error(
        "callback '{name}' is requested by name, but this context has no system file: give it one with `ContextBuilder::system`"
    )]
    NoSystem { name: String },
    /// No process runs with this system file.
    #[error("no process of domain {domain} runs with {}: start one with it, or name the domain and the path that it was given (`taut report` lists them)", path.display())]
    NobodyHas { path: PathBuf, domain: u32 },
    /// A process did not apply the new text of its system file.
    #[error("{process} did not apply the new text of {}: {why}{}", path.display(), if *changed { "; processes before it did: correct that, and run it again" } else { "; nothing was changed" })]
    NotTakenUp {
        process: String,
        path: PathBuf,
        why: String,
        /// Whether other processes have already changed.
        changed: bool,
    },
    /// A transform buffer that cannot be created.
    #[cfg(feature = "tf2_msgs")]
    #[error(transparent)]
    TransformLimits(#[from] tautline_tf::LimitsError),
    /// A callback that waits for only one topic.
    #[error("callback '{name}' of {} does not wait for several topics: list them in `all`, in place of `topic`", path.display())]
    NoJoin { name: String, path: PathBuf },
    /// A second thread tries to become the sampler.
    #[error("another thread spins this context already: a context has one sampler")]
    AlreadySpinning,
    /// A topic, publisher or subscription could not be created.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A callback could not be started, or panicked.
    #[error(transparent)]
    Executor(#[from] ExecutorError),
    /// The system refused a real-time setting.
    #[error(transparent)]
    Realtime(#[from] RtError),
    /// A message was not published.
    #[error(transparent)]
    Publish(#[from] PublishError),
    /// A message was not written in place.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The CDR of a message was not published: it is not valid for the type.
    #[error("not published: {0}")]
    InvalidCdr(Box<DecodeError>),
    /// A definition of a message type, or its name, is not valid.
    #[cfg(feature = "untyped")]
    #[error(transparent)]
    Schema(Box<dyn std::error::Error + Send + Sync>),
    /// The stored definition of a topic's type is not its definition.
    #[cfg(feature = "untyped")]
    #[error(transparent)]
    StoredDefinition(Box<dyn std::error::Error + Send + Sync>),
    /// No definition of a message type was found.
    #[cfg(feature = "untyped")]
    #[error(transparent)]
    UnknownType(Box<dyn std::error::Error + Send + Sync>),
    /// JSON or bytes are not a message of the type.
    #[cfg(feature = "untyped")]
    #[error(transparent)]
    Message(Box<dyn std::error::Error + Send + Sync>),
    /// A managed node did not begin a transition.
    #[cfg(feature = "lifecycle_msgs")]
    #[error(transparent)]
    Lifecycle(#[from] crate::state_machine::LifecycleError),
    /// A request was not sent or got no response, or a response was not sent.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// A response did not arrive within the time-out of the request.
    #[error("service '{service}': no response within {timeout:?}")]
    ServiceTimeout { service: String, timeout: Duration },
    /// The action's server did not accept a goal.
    #[error("action '{action}': the server rejected the goal")]
    GoalRejected { action: String },
    /// The client has its maximum number of awaited goals. Nothing was sent.
    #[cfg(feature = "action_msgs")]
    #[error(
        "action '{action}': this client waits for {max} goals already: await or drop the result and the feedback of one, or make a second client"
    )]
    TooManyGoals { action: String, max: usize },
    /// A goal was accepted, but its result cannot be requested.
    #[cfg(feature = "action_msgs")]
    #[error(
        "action '{action}': the goal was accepted, but its result cannot be requested ({source}); {fate}"
    )]
    GoalUnheard {
        action: String,
        /// What happens to the goal.
        fate: String,
        source: Box<Error>,
    },
    /// The operation is not possible in the goal's state.
    #[cfg(feature = "action_msgs")]
    #[error("action '{action}': goal {goal} is {status}: this is no longer possible, or not yet")]
    Goal { action: String, goal: String, status: crate::goal_state::GoalStatus },
    /// The action's server rejected the cancellation and continues with the goal.
    #[error("the action's server rejected the request to cancel the goal")]
    GoalCancelRejected,
    /// The action's server does not know the goal, or has forgotten it.
    #[error(
        "the action's server does not know the goal that is to be cancelled: its result has expired, or it is another server's"
    )]
    GoalCancelUnknownGoalID,
    /// The goal to be cancelled has already ended.
    #[error("the goal that is to be cancelled has ended already: await its result")]
    GoalCancelAlreadyTerminated,
    /// A message cannot be encoded as CDR.
    #[error(transparent)]
    Serialize(#[from] EncodeError),
    /// Bytes are not the CDR of a message.
    #[error(transparent)]
    Deserialize(Box<DecodeError>),
    /// No sample was taken.
    #[error(transparent)]
    Take(#[from] TakeError),
}

impl From<ParameterError> for Error {
    fn from(error: ParameterError) -> Self {
        Error::Parameter(error.into())
    }
}

#[cfg(feature = "untyped")]
impl From<tautline_schema::SchemaError> for Error {
    fn from(error: tautline_schema::SchemaError) -> Self {
        Error::Schema(error.into())
    }
}

#[cfg(feature = "untyped")]
impl From<tautline_schema::MessageError> for Error {
    fn from(error: tautline_schema::MessageError) -> Self {
        Error::Message(error.into())
    }
}

#[cfg(feature = "untyped")]
impl From<tautline_definitions::DefinitionError> for Error {
    fn from(error: tautline_definitions::DefinitionError) -> Self {
        use tautline_definitions::DefinitionError;
        match error {
            DefinitionError::Unknown { .. } => Error::UnknownType(error.into()),
            DefinitionError::Stored { .. } => Error::StoredDefinition(error.into()),
            error => Error::Schema(error.into()),
        }
    }
}

impl From<PublishCdrError> for Error {
    fn from(error: PublishCdrError) -> Self {
        match error {
            PublishCdrError::Invalid(error) => Error::InvalidCdr(error.into()),
            PublishCdrError::Publish(error) => Error::Publish(error),
        }
    }
}

impl From<DecodeError> for Error {
    fn from(error: DecodeError) -> Self {
        Error::Deserialize(error.into())
    }
}

impl From<LoanError> for Error {
    fn from(error: LoanError) -> Self {
        Error::Publish(error.into())
    }
}

/// The loan is dropped: take it from [`SendError::loan`] to keep it.
impl<L> From<SendError<L, ServiceError>> for Error {
    fn from(unsent: SendError<L, ServiceError>) -> Self {
        Error::Service(unsent.error)
    }
}

/// How many messages were published is dropped: take it from [`BurstError::published`] to keep it.
impl<E: Into<Error>> From<BurstError<E>> for Error {
    fn from(burst: BurstError<E>) -> Self {
        burst.error.into()
    }
}

/// The loan is dropped: take it from [`SendError::loan`] to keep it.
impl<L> From<SendError<L>> for Error {
    fn from(unsent: SendError<L>) -> Self {
        Error::Publish(unsent.error)
    }
}

/// The sentence of [`Display`](std::fmt::Display): what `fn main() -> tautline::Result<()>` prints is meant to be read.
impl std::fmt::Debug for Error {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        std::fmt::Display::fmt(self, f)
    }
}

/// The result of setting something up.
pub type Result<T, E = Error> = std::result::Result<T, E>;
