// SPDX-License-Identifier: MIT OR Apache-2.0
//! A thin, safe layer over rcl, through r2r's bindings: carries bytes and reads the graph. All `unsafe` of the crate is here.
//!
//! rcl's objects are created and destroyed by one thread at a time ([`Node`] has the lock). Publishing and reading the graph are
//! thread-safe; taking, and waiting with one wait set, need one thread at a time, hence `&mut`.

mod context;
mod end;
mod error;
mod events;
mod graph;
mod guard;
mod profile;
mod publications;
mod publisher;
mod serialized;
mod service;
mod service_support;
mod subscription;
mod type_support;
mod wait;

pub use context::{Context, Node, rmw_implementation};
pub use error::RclError;
pub use graph::RosEndpoint;
pub use guard::{GraphGuard, GuardCondition};
pub use profile::ignore_own_endpoints;
pub use publisher::RosPublisher;
pub use serialized::SerializedMessage;
pub use service::{RosClient, RosRequestId, RosServer};
pub use service_support::{RosStruct, ServiceSupport};
pub use subscription::{RosMessageInfo, RosSubscription};
pub use type_support::{MessageSupport, TypeSupportError, is_message_type, is_service_type};
pub use wait::{WaitSet, Waitable};
