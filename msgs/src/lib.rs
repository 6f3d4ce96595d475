// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages: plain ones whose bytes in memory are their CDR, views and writers for those of any length, and owned ones converted
//! to and from it.
//!
//! A topic carries one format, on the network and in shared memory: the XCDR1 little-endian body that ROS 2 sends
//! (without its 4 encapsulation bytes), starting at an 8-byte aligned address. For a [`Plain`] type these bytes *are*
//! the Rust value, so writing and reading a message is writing and reading memory.
//!
//! ```
//! use tautline_msgs::{Message, Plain};
//!
//! #[derive(Message, Clone, Copy, Debug, PartialEq)]
//! #[message(name = "demo_msgs/msg/Tick", crate = "tautline_msgs")] // `crate` is not needed with package `tautline`
//! #[repr(C)]
//! struct Tick {
//!     stamp_ns: u64,
//!     count: u32,
//!     valid: bool,
//! }
//!
//! #[repr(align(8))]
//! struct Body([u8; 16]);
//!
//! // What `ros2 topic pub` would have sent: 8 + 4 + 1 bytes, here in a buffer with room for the trailing padding.
//! let body = Body([1, 0, 0, 0, 0, 0, 0, 0, 7, 0, 0, 0, 1, 0, 0, 0]);
//! let tick: &Tick = tautline_msgs::from_bytes(&body.0)?;
//! assert_eq!(*tick, Tick { stamp_ns: 1, count: 7, valid: true });
//! assert_eq!(Tick::TYPE_NAME, "demo_msgs/msg/Tick");
//! assert_eq!(Tick::CDR_SIZE, 13);
//! # Ok::<(), tautline_msgs::Invalid>(())
//! ```
//!
//! | module | holds |
//! |---|---|
//! | `message` | [`Message`]: name, hash, definition; in place, to CDR and back |
//! | `body` | [`Body`]: bytes that should be a message, not validated yet, where they can be read in place |
//! | `definition`, `shape` | [`Definition`]: the text of a type's definition; [`definition_text`], also of a derived type |
//! | `plain` | [`Plain`]: layout and validity; [`from_bytes`], [`write_cdr`] |
//! | `primitives` | `Plain` for integers, floats, `bool`, `char`, arrays |
//! | `invalid` | [`Invalid`]: why bytes are not a value |
//! | `layout` | the compile-time proof that C layout is CDR layout, called by the derive |
//! | [`cdr`] | fields of any size: owned, read in place, written in place |
//! | `generated` | the macros that generated code calls |
//! | `service` | [`Service`], [`Action`] |
//! | `stamp` | [`HasStamp`]: the time of a message's measurement |

#[macro_use]
mod generated;
mod body;
pub mod cdr;
mod definition;
mod invalid;
#[doc(hidden)]
pub mod layout;
mod message;
mod plain;
mod primitives;
#[doc(hidden)]
pub mod serde_fields;
mod service;
mod shape;
mod stamp;

pub use body::{BODY_ALIGN, Body};
pub use definition::Definition;
#[doc(hidden)]
pub use definition::definition_of;
pub use invalid::Invalid;
#[doc(hidden)]
pub use message::PlainView;
pub use message::{HEADER, Message, split_header};
pub use plain::{Plain, from_bytes, write_cdr};
#[doc(hidden)]
pub use plain::{dense_end, read_dense, read_dense_vec, view_plain, write_dense};
/// For generated code.
#[doc(hidden)]
pub use serde;
pub use service::{Action, GoalId, Service};
pub use shape::definition_text;
#[doc(hidden)]
pub use shape::{Shape, StructShape};
pub use stamp::{HasStamp, time_ns};
/// Derives [`Plain`] for a struct or field-less enum, and the trait [`Message`](trait@Message) for a struct that is a
/// topic's type.
///
/// - `#[message(name = "demo_msgs/msg/Tick")]` on a struct: its ROS name; implements `Message` as well.
/// - `#[message(nested)]` on a struct: only a field of other messages; implements `Plain` alone.
/// - `#[message(crate = "path")]`: where this crate is found, default `::tautline::msgs`.
///
/// A struct is `#[repr(C)]` with named [`Plain`] fields; an enum is `#[repr(u8)]` (or `i8`, `u16`, `i16`, `u32`,
/// `i32`) without fields and has a variant of value 0. Both are `Clone + Copy`. A struct whose C layout differs from
/// its CDR does not compile; the error names the field and the padding to insert.
pub use tautline_msgs_derive::Message;

/// Includes the modules of the packages that `tautline-build` generated in `build.rs`.
#[macro_export]
macro_rules! include_packages {
    () => {
        ::core::include!(::core::concat!(::core::env!("OUT_DIR"), "/tautline_packages.rs"));
    };
}

#[cfg(target_endian = "big")]
compile_error!("plain messages are little-endian CDR read in place: big-endian targets are not supported");
