// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline as one shared library, for a process and the components that it loads: name it in both, with
//! `use tautline_dylib as _;`, and both link against the same copy.
//!
//! No member of the workspace: cargo links a library of type `dylib` against a shared `std`, which all of them need, only if it is
//! a dependency from elsewhere.
#![forbid(unsafe_code)]

pub use tautline;
pub use tautline_components;
