// SPDX-License-Identifier: MIT OR Apache-2.0
//! ROS 2 type definitions: parsing, hashing, dynamic messages.
//!
//! ```text
//! .msg .srv .action ─ parse ──────┐                 ┌─ TypeDescription ─ TypeHash (RIHS01)
//! text of bags (ros2msg) ─ bundle ├─ Definition ─ Schema ─ Layout: plain or not, offsets, sizes
//! type description ───────────────┘                 └─ DynamicMessage ─ CDR, JSON, YAML, paths
//! ```
//!
//! A [`Definition`] is the content of one file, or what ROS derives from it (`SetBool_Request`, `Fibonacci_SendGoal`).
//! A [`Schema`] is a definition with all others that it needs, known to be complete, not recursive and of a size that
//! can be handled; generators, hashes, layouts and decoders start from it. Services and actions are definitions too,
//! whose fields are the types they consist of, as in ROS's type descriptions.
//!
//! ```
//! use tautline_schema::{DynamicMessage, Layout, Packages, Size};
//!
//! let mut packages = Packages::from_env(); // a sourced ROS 2, if there is one
//! let name = "demo_msgs/msg/Tick".parse()?;
//! packages.add_text(&name, "Tick.msg", "uint8 LOST=255\nbuiltin_interfaces/Time stamp\nuint8 count 1 # ticks\n")?;
//!
//! let schema = packages.schema(&name)?;
//! assert_eq!(schema.definition().fields[1].docs, "ticks");
//! assert!(schema.hash().to_string().starts_with("RIHS01_"));
//! assert_eq!(Layout::of(&schema).size, Size::Fixed(9));
//! assert_eq!(DynamicMessage::new(&schema.into()).to_string(), "stamp:\n  sec: 0\n  nanosec: 0\ncount: 1\n");
//! # Ok::<(), tautline_schema::SchemaError>(())
//! ```
//!
//! Everything here accepts untrusted input and is for tools and set-up: it allocates, reports errors with their
//! position, and never panics. The hot path uses `tautline-msgs`.
//!
//! | module | holds |
//! |---|---|
//! | `names`, `field_type`, `value`, `definition` | [`TypeName`], [`FieldType`], [`Value`], [`Definition`]: the plain data |
//! | `parse` | text of files to definitions |
//! | `derived`, `well_known` | what ROS derives from services and actions, and with which messages |
//! | `bundle` | a type and all it consists of as one text |
//! | `packages` | [`Packages`]: finds definitions on disk |
//! | `schema` | [`Schema`]: looks up, checks, measures |
//! | `description`, `hash` | [`TypeDescription`], [`TypeHash`] |
//! | `layout` | [`Layout`]: offsets and sizes |
//! | `message`, `cdr`, `path`, `text`, `echo`, `check` | [`DynamicMessage`] and its forms |
//!
//! Why the parser is our own and not `hiroz-codegen`'s: see `docs/adr/0004-own-schema-parser.md`.
#![forbid(unsafe_code)]

mod bundle;
mod cdr;
mod check;
mod definition;
mod derived;
mod description;
mod echo;
mod error;
mod field_type;
mod hash;
mod layout;
mod message;
mod message_error;
mod names;
mod number;
mod packages;
mod parse;
mod path;
mod schema;
mod text;
mod value;
mod well_known;

pub use definition::{Constant, Definition, Field};
pub use description::{
    FieldDescription, FieldTypeDescription, HashedTypeDescription, IndividualTypeDescription, NamedHash,
    TypeDescription,
};
pub use echo::EchoForm;
pub use error::{Fault, Place, SchemaError};
pub use field_type::{Base, FieldType, Primitive, Shape};
pub use hash::TypeHash;
pub use layout::{FieldLayout, Layout, NotPlain, Plain, Size};
pub use message::{DynamicMessage, Endian};
pub use message_error::{DecodeFault, MessageError};
pub use names::{Kind, TypeName};
pub use packages::Packages;
pub use parse::{parse, parse_action, parse_message, parse_service};
pub use schema::{Lookup, Schema};
pub use value::{List, Value};
