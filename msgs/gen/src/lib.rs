// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rust types from ROS 2 definitions.
//!
//! ```
//! use tautline_gen::{Options, generate};
//! use tautline_schema::Packages;
//!
//! let mut packages = Packages::new(); // or from_env(), where ROS 2 is installed
//! packages.add_folder("../ros/definitions"); // <package>/msg/<Name>.msg
//!
//! let code = generate(&mut packages, &["builtin_interfaces"], &Options::default())?;
//! assert!(code.contains("pub struct Time {"));
//! # Ok::<(), tautline_gen::GenerateError>(())
//! ```
//!
//! A package becomes a module, with the paths of r2r: `std_msgs::msg::String`, `std_srvs::srv::SetBool::{Service,
//! Request, Response, Event}`, `example_interfaces::action::Fibonacci::{Action, Goal, Result, Feedback, FeedbackMessage,
//! SendGoal, GetResult}`. A message is a struct with public fields, constants, ROS's defaults, serde, and `Message` of
//! `tautline-msgs`. It is `Plain` if its memory can be its CDR; if not, `ImageRef`, `ImageWriter` and `ImageSizes` read
//! and write it in place. A name gets a `_` at its end if it is a keyword; so does one of these three if a message of the package has
//! that name. Fields are documented with their comments, and those of ROS 2's own messages with their units. The text is
//! formatted as rustfmt does, without needing it.
//!
//! | module | holds |
//! |---|---|
//! | `package` | [`generate`]: modules and what lies in them |
//! | `message` | the struct of a message |
//! | `memory` | how it lies in memory |
//! | `in_place` | getters and sizes |
//! | `types` | Rust types, CDR forms and literals of fields |
//! | `names` | paths, and names that are keywords |
//! | `units` | what fields are measured in |
//! | `text` | lines and their indentation |
#![forbid(unsafe_code)]

mod error;
mod in_place;
mod memory;
mod message;
mod names;
mod package;
mod text;
mod types;
mod units;

pub use error::GenerateError;
pub use names::Options;
pub use package::{RustType, generate, messages};
