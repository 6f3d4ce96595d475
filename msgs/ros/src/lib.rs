// SPDX-License-Identifier: MIT OR Apache-2.0
//! The message packages of ROS 2 Jazzy as Rust types, generated from their definitions.
//!
//! A package is a module, and there if the cargo feature of its name is on. Paths are those of r2r:
//! `std_msgs::msg::String`, `std_srvs::srv::SetBool::Request`, `example_interfaces::action::Fibonacci::Goal`. Every
//! message has public fields, its constants, ROS's defaults, serde, and [`Message`](tautline_msgs::Message); every service
//! and action a unit struct with [`Service`](tautline_msgs::Service) or [`Action`](tautline_msgs::Action). A message whose
//! memory can be its CDR is [`Plain`](tautline_msgs::Plain); any other is read in place through its `Ref` and written in
//! place through its `Writer`.
//!
//! ```
//! use tautline_msgs::Message;
//! use tautline_ros_msgs::geometry_msgs::msg::{Quaternion, Twist};
//!
//! assert_eq!(Twist::TYPE_NAME, "geometry_msgs/msg/Twist");
//! let mut twist = Twist::default();
//! twist.linear.x = 0.5;
//!
//! let mut body = [0; 48]; // a loan, for example
//! assert_eq!(twist.encode(&mut body)?, twist.cdr_len());
//! assert_eq!(Twist::decode(&body, tautline_msgs::cdr::Endian::Little)?, twist);
//! assert_eq!(Quaternion::default().w, 1.0); // as the definition says
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Build times
//!
//! This crate alone, its dependencies built: seconds of processor time, measured on 2 cores. A release build uses all cores.
//!
//! | features | `cargo check` | debug build | release build |
//! |---|---|---|---|
//! | default: 5 packages | 1.8 | 2.0 | 10 |
//! | `all`: 23 packages | 5.8 | 7.1 | 37 |
#![forbid(unsafe_code)]
include!(concat!(env!("OUT_DIR"), "/packages.rs"));
