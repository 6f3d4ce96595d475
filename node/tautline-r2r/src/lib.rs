// SPDX-License-Identifier: MIT OR Apache-2.0
//! The API of [r2r](https://docs.rs/r2r) 0.9.7 on Tautline.
//!
//! A program that was written for r2r compiles and runs unchanged with this line in its `Cargo.toml`:
//!
//! ```toml
//! r2r = { package = "tautline-r2r", version = "0.1", features = ["ros_all"] }
//! ```
//!
//! This crate contains only what exists for r2r: its [`QosProfile`], getters that return a `Result`, a mutex of parameters, alternative
//! names. Everything else belongs to [`tautline`]. [`Node`], [`Publisher`] and the other types dereference to those of [`tautline`], so
//! a program can be ported line by line. docs/r2r.md compares the two APIs name by name.
//!
//! ```
//! use futures::{StreamExt, executor::LocalPool, task::LocalSpawnExt};
//! use tautline_r2r::{self as r2r, QosProfile, std_msgs::msg::String as Text};
//!
//! # let ctx = r2r::Context::builder().domain(228).realtime(r2r::Realtime::Off).build()?;
//! # /*
//! let ctx = r2r::Context::create()?;
//! # */
//! let mut node = r2r::Node::create(ctx, "testnode", "")?;
//! let mut words = node.subscribe::<Text>("/words", QosProfile::default())?;
//! let publisher = node.create_publisher::<Text>("/words", QosProfile::default())?;
//! publisher.publish(&Text { data: "taut".into() })?;
//!
//! let mut pool = LocalPool::new();
//! let heard = pool.spawner().spawn_local_with_handle(async move { words.next().await }).unwrap();
//! node.spin_once(std::time::Duration::from_millis(100));
//! assert_eq!(pool.run_until(heard).unwrap().data, "taut");
//! # Ok::<(), r2r::Error>(())
//! ```
#![forbid(unsafe_code)]

/// Implements the conversion from the wrapped type, and the dereference to it.
macro_rules! beneath {
    ($name:ident $(<$type:ident: $bound:ident>)? $(, $rest:expr)?) => {
        beneath!($name $(<$type: $bound>)? = tautline::$name$(<$type>)? $(, $rest)?);
    };
    ($name:ident $(<$type:ident: $bound:ident>)? = $inner:ty $(, $rest:expr)?) => {
        impl$(<$type: $bound>)? From<$inner> for $name$(<$type>)? {
            fn from(inner: $inner) -> Self {
                $name(inner $(, $rest)?)
            }
        }

        impl$(<$type: $bound>)? std::ops::Deref for $name$(<$type>)? {
            type Target = $inner;

            fn deref(&self) -> &Self::Target {
                &self.0
            }
        }

        impl$(<$type: $bound>)? std::ops::DerefMut for $name$(<$type>)? {
            fn deref_mut(&mut self) -> &mut Self::Target {
                &mut self.0
            }
        }
    };
}

mod action;
mod client;
mod message;
mod node;
mod publisher;
mod qos;
mod time;
mod untyped;

#[doc(no_inline)]
pub use ::tautline;
pub use action::{
    ActionClient, ActionClientGoal, ActionClientGoalUntyped, ActionClientUntyped, ActionServerGoal,
    ActionServerGoalRequest,
};
pub use client::{Client, ClientUntyped, IsAvailablePollable};
pub use message::{NativeMsg, ROS_DISTRO, WrappedTypesupport};
pub use node::{Node, TopicEndpointInfo};
pub use publisher::{Publisher, PublisherUntyped};
pub use qos::{DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QosProfile, ReliabilityPolicy};
pub use tautline::msgs::{Action as WrappedActionTypeSupport, Service as WrappedServiceTypeSupport};
pub use tautline::*;
pub use time::{Clock, TimeSource, Timer};
pub use untyped::WrappedNativeMsgUntyped;

/// Functions that the macros' code calls.
#[doc(hidden)]
pub mod __private {
    pub use tautline::__private::{Site, field, no_field};
}
