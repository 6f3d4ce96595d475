// SPDX-License-Identifier: MIT OR Apache-2.0
//! Managed nodes: states, transitions, and publishers that are silent unless the node is active.

mod machine;
mod node;
mod services;

pub use machine::{CallbackReturn, InvalidTransition, State, StateMachine, Transition};
pub use node::{LifecycleCallbacks, LifecycleError, LifecycleNode, ManagedNode, Transitioned};
