// SPDX-License-Identifier: MIT OR Apache-2.0
//! Topics over shared memory, and the doorbell that announces their samples.
//!
//! A [`Participant`] joins a domain and creates publishers and subscriptions. A [`Publisher`] loans a sample, which is
//! written in place and published without waiting; a [`Subscription`] takes it and reads it in place. The samples lie in iceoryx2's
//! pools and travel through iceoryx2's queues. Tautline's own [`Doorbell`], one per sampler, announces new samples.
//!
//! - **Zero copy.** Shared memory contains the message's CDR, of a fixed size or not: written there field by field, or as a
//!   `&mut T` if the type is [plain](tautline_msgs::Plain), and read there through its [view](tautline_msgs::Message::View).
//! - **Bytes below, types above.** [`RawPublisher`] and [`RawSubscription`] carry bodies of any length without reading them;
//!   [`Publisher`] and [`Subscription`] are a thin layer over them. Endpoints of a topic with different [`TopicType`]s do not
//!   match.
//! - **Settings per endpoint.** Each endpoint has its own depth, message size and other settings; a topic has no limits.
//! - **Nothing waits in publish.** A slow keep-last subscription loses its oldest samples and counts them; a full
//!   keep-all one makes publish return `Full` with the loan.
//! - **No lock between threads of different priority** on a sample's path, in this process or between
//!   processes.
//! - **Crashes.** A process may be killed at any instant: the other processes continue, and one of them
//!   cleans up after it.
//!
//! ```
//! # use tautline_transport::{Limits, Participant, Qos};
//! # #[derive(tautline_msgs::Message, Clone, Copy)] #[repr(C)]
//! # #[message(name = "demo_msgs/msg/Count", crate = "tautline_msgs")]
//! # struct Count { n: u64 }
//! let participant = Participant::new(120)?;
//! let subscription = participant.create_subscription::<Count>("/count", Qos::default(), Limits::default())?;
//! let publisher = participant.create_publisher::<Count>("/count", Qos::default(), Limits::default())?;
//!
//! let mut loan = publisher.loan().expect("a loan is free");
//! loan.n = 7;
//! loan.publish().expect("keep-last never refuses");
//!
//! let sample = subscription.try_take().expect("nothing else is held").expect("it was just published");
//! assert_eq!((sample.n, sample.info().sequence_number), (7, 1));
//! # Ok::<(), tautline_transport::TransportError>(())
//! ```

extern crate iceoryx2_bb_loggers as _;

mod cleanup;
mod error;
mod graph;
mod low_priority;
mod memory;
mod names;
mod observe;
mod qos;
mod service;
mod sync;
#[cfg(all(test, not(taut_loom)))]
mod tests;
mod topic;

pub use error::{BurstError, LoanError, PublishCdrError, PublishError, SendError, TakeError, TransportError};
pub use graph::domain::{MAX_DOMAIN, is_dead_domain, remove_dead_domain};
pub use graph::entities::{
    Death, EndpointKind, GraphSnapshot, NodeInfo, NodeName, ServiceEndpoint, ServiceKind, TopicEndpoint,
};
pub use graph::events::GraphEvents;
pub use graph::origin::{Origin, Rank};
pub use graph::own::NodeHandle;
pub use graph::remote::{RemoteGraph, RemoteNode};
pub use graph::schema_store::{ClaimedSchema, MAX_SCHEMA_BYTES, SchemaStore};
pub use graph::topic_type::TopicType;
pub use memory::control::Sent;
pub use memory::header::{Gid, MessageInfo};
pub use memory::sizes::{TopicMemory, topic_memory};
pub use observe::graph::TopicInfo;
pub use observe::monitor::publisher::{PublisherChanges, PublisherMonitor};
pub use observe::monitor::subscription::{SubscriptionChanges, SubscriptionMonitor};
pub use observe::monitor::{IncompatibleQos, IncompatibleType, LivelinessChanged, Matched, MessageLost};
pub use observe::recorder::{call_all, start_recorder};
pub use observe::traced::{TracedPort, TracedSample, TracedSender};
pub use observe::visitor::{Visitor, graph_of};
pub use qos::{Claim, Durability, History, Limits, Liveliness, Qos, Reliability};
pub use service::client::{Availability, RawClient, RawPending};
pub use service::error::ServiceError;
pub use service::pending::MAX_PENDING_REQUESTS;
pub use service::queued::QueuedClient;
pub use service::server::{RawResponse, RawServer, RequestId};
pub use service::service_type::ServiceType;
pub use service::typed::{
    Client, PendingResponse, Request, Response, Server, ServiceCodec, UnwrittenResponse,
};
pub use tautline_doorbell::{
    Activity, ActivityKind, Arena, ArenaId, BellRoute, Doorbell, DoorbellError, Flags, GrowArena,
    SamplerSeat, Signal, Sleeper, Slot, ThreadBell, Wakeable,
};
pub use topic::compatibility::QosPolicyKind;
pub use topic::endpoints::MatchedCount;
pub use topic::participant::Participant;
pub use topic::publisher::RawPublisher;
pub use topic::publisher::claimer::MemoryClaimer;
pub use topic::publisher::counters::PublisherCounters;
pub use topic::publisher::gate::Gate;
pub use topic::publisher::hot::RawLoan;
pub use topic::subscription::hot::RawSample;
pub use topic::subscription::{RawSubscription, SubscriptionCounters};
pub use topic::typed::hot::{Loan, Sample, Unwritten};
pub use topic::typed::{Codec, Decode, Publisher, Subscription};
