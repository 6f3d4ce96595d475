// SPDX-License-Identifier: MIT OR Apache-2.0
//! Owned messages to CDR and back.
//!
//! The format is XCDR1 as ROS 2 uses it. A primitive is aligned to its size, counted from the start of the body. A
//! string is its length with the zero byte at its end as `uint32`, then its UTF-8 and that byte; a `wstring` the number
//! of its UTF-16 units, then each in four bytes. A sequence is its length, then its elements. Padding is zero.
//!
//! | module | holds |
//! |---|---|
//! | `message` | [`Cdr`]: a message as a whole, with its header or without |
//! | `form` | [`Form`]: one field; `String`, `Vec`, arrays, [`WString`], [`Bounded`] |
//! | `numbers` | `Form` for numbers and `bool`, copied in bulk |
//! | `structs` | the macro that generated code calls |
//! | `writer`, `reader` | [`Writer`] and [`Reader`]: bytes and how far they are written or read |
//! | `error` | [`EncodeError`], [`DecodeError`] |

mod error;
mod form;
mod message;
mod numbers;
mod reader;
mod structs;
mod writer;

pub use error::{DecodeError, DecodeFault, EncodeError, EncodeFault};
pub use form::{Bound, Bounded, Form, WString};
pub use message::{Cdr, Endian, HEADER};
pub use reader::Reader;
pub use writer::Writer;
