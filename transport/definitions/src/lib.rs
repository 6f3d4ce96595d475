// SPDX-License-Identifier: MIT OR Apache-2.0
//! Definitions of types that are known at run time only: kept beside topics, installed, or bundled.
//!
//! ```
//! let schema = tautline_definitions::find_schema("/chatter", &"std_msgs/msg/String".parse()?, None)?;
//! assert_eq!(tautline_definitions::type_of(&schema).name, "std_msgs/msg/String");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

mod bundled;
mod find;

pub use bundled::Bundled;
pub use find::{DefinitionError, find_schema, type_of};
