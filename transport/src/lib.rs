// SPDX-License-Identifier: MIT OR Apache-2.0
//! Topics over shared memory, and the doorbell that announces their samples.
//!
//! A [`Participant`] joins a domain and creates publishers and subscriptions. A [`Publisher`] loans a sample, which is
//! written in place and published without waiting; a [`Subscription`] takes it and reads it in place. The samples travel
//! through iceoryx2; that one is there is announced by Tautline's own [`Doorbell`], one per sampler: iceoryx2's event
//! service can lose a wake-up for ever.
//!
//! - **Zero copy.** What lies in shared memory is the message's CDR, of a fixed size or not: written there field by field, or
//!   as a `&mut T` if the type is [plain](tautline_msgs::Plain), and read there through its
//!   [view](tautline_msgs::Message::View).
//! - **Bytes below, types above.** [`RawPublisher`] and [`RawSubscription`] carry bodies of any length and look at none;
//!   [`Publisher`] and [`Subscription`] are a thin layer over them. All ends of a topic agree on the [`TopicType`].
//! - **Nothing waits in publish.** A slow keep-last subscription loses its oldest samples and counts them; a full
//!   keep-all one makes publish return `Full` with the loan.
//! - **No lock between threads of different priority** on the way of a sample, in this process or another.
//! - **Crashes.** A process may be killed at any instant: others go on, the janitor removes what it left.
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

mod address;
mod compatibility;
mod dead_nodes;
mod doorbell;
mod error;
mod graph;
mod header;
mod history;
mod janitor;
mod lending;
mod memory;
mod monitor;
mod nodes;
mod participant;
mod ports;
mod publisher;
mod qos;
mod schema_store;
mod service;
mod subscription;
mod sync;
mod topic;
mod topic_type;
mod topics;
mod typed;

pub use compatibility::QosPolicyKind;
pub use doorbell::{Doorbell, Pulse, PulseOf, SLOTS, SamplerSeat, Slot, ThreadBell};
pub use error::{LoanError, PublishCdrError, PublishError, TakeError, TransportError};
pub use header::{Gid, MessageInfo};
pub use memory::{TopicMemory, topic_memory};
pub use monitor::{
    IncompatibleQos, LivelinessChanged, Matched, MessageLost, PublisherChanges, PublisherMonitor,
    SubscriptionChanges, SubscriptionMonitor,
};
pub use nodes::{
    EndpointKind, GraphEvents, GraphSnapshot, NodeHandle, NodeInfo, NodeName, RemoteGraph, ServiceEndpoint,
    ServiceKind, ServiceRegistration, TopicEndpoint,
};
pub use participant::{MAX_DOMAIN, Participant, file_prefix};
pub use publisher::{Gate, PublisherCounters, RawLoan, RawPublisher, Unpublished};
pub use qos::{Durability, History, Limits, Liveliness, Qos, Reliability};
pub use schema_store::{ClaimedSchema, MAX_SCHEMA_BYTES, SchemaStore};
pub use service::{
    Availability, Client, MAX_PENDING_REQUESTS, PendingResponse, RawClient, RawPending, RawResponse,
    RawServer, Request, RequestId, Responders, Response, Server, ServiceError, ServiceInfo, ServiceType,
    Unsent, UnwrittenResponse,
};
pub use subscription::{Counters, RawSample, RawSubscription};
pub use topic_type::TopicType;
pub use topics::{EndpointInfo, TopicInfo};
pub use typed::{Loan, Publisher, Sample, Subscription, Unwritten};
