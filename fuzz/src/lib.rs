// SPDX-License-Identifier: MIT OR Apache-2.0
//! Checks of everything that takes input from outside. Each is a function of bytes, which `fuzz_targets` gives to
//! libFuzzer: `cargo xtask fuzz` runs them under the address sanitizer.
//!
//! | target | input | must hold |
//! |---|---|---|
//! | [`owned`] | type, byte order, body | what is decoded is encoded again as the same message |
//! | [`dynamic`] | type or definition, byte order, body | the same; and it is what the owned type makes of the bytes |
//! | [`plain`] | type, place, bytes | reading in place, checking and decoding agree |
//! | [`view`] | type, body | a body is read in place exactly if it is decoded, and as the same message |
//! | [`fill`] | type, lengths, memory, value | nothing is written outside of what the lengths say; what is written is a message |
//! | [`schema`] | definitions, bundles, type descriptions | what is accepted is written as text that says the same |
//! | [`json`], [`yaml`] | type, text | what is read is written as text that says the same |
//! | [`system`] | system files, or pieces of them | what is accepted has bounds, or says why not |
//! | [`bag`] | files of bags | what is whole is read, the rest is damage |
//! | [`wire`] | keys, tokens and attachments of other hosts | what is accepted is written as what says the same |
//!
//! All of them: no panic, no byte read that is not there, and but for [`bag`], whose chunks are compressed, and [`system`], no allocation larger
//! than a multiple of the input, which each file states: a length that the input claims is not believed.
//!
//! The first bytes of an input choose the type: see `input`.

mod allocations;
mod bag;
mod dynamic;
mod entry;
mod fill;
mod input;
mod memory;
mod plain;
mod schema;
mod system;
mod text;
mod wire;

pub use allocations::Counting;
pub use bag::bag;
pub use dynamic::dynamic;
pub use entry::{fill, owned, type_names, view};
pub use plain::plain;
pub use schema::schema;
pub use system::system;
pub use text::{json, yaml};
pub use wire::wire;
