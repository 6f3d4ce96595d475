// SPDX-License-Identifier: MIT OR Apache-2.0
//! For `build.rs`: Rust types from a project's own ROS 2 definitions.
//!
//! ```text
//! Cargo.toml            [build-dependencies] tautline-build
//! build.rs
//! msgs/demo_msgs/msg/Track.msg
//! src/main.rs
//! ```
//!
//! ```no_run
//! // build.rs
//! fn main() -> Result<(), tautline_build::Error> {
//!     tautline_build::packages("msgs/")
//! }
//! ```
//!
//! ```ignore
//! // src/main.rs
//! tautline::msgs::include_packages!();
//!
//! use demo_msgs::msg::Track;
//! ```
//!
//! Each package becomes a module; the documentation of `tautline-gen` describes its content. A field may be of a
//! type of another package:
//!
//! | package | its types are |
//! |---|---|
//! | in the folders | generated with the others |
//! | bundled with Tautline: `std_msgs`, `geometry_msgs` ... | those of `::tautline`, see [`Builder::bundled`] |
//! | of an installed ROS 2 (`AMENT_PREFIX_PATH`) | generated as well, as far as they are needed |
//!
//! The cargo features of the bundled packages that are needed must be on: those of fields, `service_msgs` for services,
//! `service_msgs` and `unique_identifier_msgs` for actions, as in `tautline = { version = "0.1", features = ["service_msgs"] }`.
//!
//! A definition that is wrong fails the build with its file, line and column. Cargo builds again when a
//! definition changes or a new one appears.
#![forbid(unsafe_code)]

mod builder;
mod bundled;
mod error;
mod folder;

pub use builder::{Builder, packages};
pub use error::Error;
