// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes in shared libraries, loaded at run time into one process.
//!
//! A crate of type `cdylib` exports [`components!`]. A [`Container`] loads it, and creates its components with nodes that share
//! the process's context and sampler. A library is used only if its stamp, read from the file, shows that it was built by the
//! same compiler, with the same version of Tautline, for the same target.
//!
//! **One copy.** Process and components link against `tautline-dylib`, which contains all of Tautline. Two copies in one process
//! would each have their own log, trace, scope and types; a library with its own copy is refused.

mod container;
mod entry;
mod error;
mod services;
mod stamp;

pub use container::{Container, Load};
pub use entry::{Create, Library, Plugin};
pub use error::ComponentError;
pub use services::{SharedContainer, serve};
pub use stamp::{STAMP, STAMP_BYTES};
