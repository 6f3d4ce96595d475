// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes in shared libraries, loaded at run time into one process.
//!
//! A crate of type `cdylib` exports [`components!`]; a [`Container`] loads it, and makes nodes of its components that share the
//! process's context and sampler. A library is only touched if its stamp, read from the file, says that it was built by the same
//! compiler, with the same version of Tautline, for the same target.
//!
//! **One copy.** Process and components link against `tautline-dylib`, which has all of Tautline in it. Two copies in one process
//! would each have a log, a trace and a scope of their own, and types that are not the other's; a library with a copy of its own
//! is refused.

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
