// SPDX-License-Identifier: MIT OR Apache-2.0
//! Managed nodes: states, transitions, and publishers that are silent unless the node is active.
//!
//! ```
//! use tautline::lifecycle::{CallbackReturn, LifecycleCallbacks, LifecycleNode, ManagedNode, State};
//! use tautline::{Context, Realtime};
//!
//! struct Driver;
//! impl LifecycleCallbacks for Driver {
//!     fn on_configure(&mut self, node: &mut ManagedNode) -> CallbackReturn {
//!         println!("{} is configured", node.name());
//!         CallbackReturn::Success
//!     }
//! }
//!
//! let ctx = Context::builder().domain(201).realtime(Realtime::Off).build()?;
//! let node = LifecycleNode::create(ctx, "driver", "", Driver)?;
//! node.configure()?;
//! assert_eq!(node.state(), State::Inactive);
//! # Ok::<(), tautline::Error>(())
//! ```

mod node;
mod services;

pub use crate::state_machine::{
    CallbackReturn, InvalidTransition, LifecycleError, State, StateMachine, Transition,
};
pub use node::{LifecycleCallbacks, LifecycleNode, ManagedNode, Transitioned};
