// SPDX-License-Identifier: MIT OR Apache-2.0
//! Owned messages to CDR and back.
//!
//! The format is XCDR1 as ROS 2 uses it. A primitive is aligned to its size, counted from the start of the body. A
//! string is its length with the zero byte at its end as `uint32`, then its UTF-8 and that byte; a `wstring` the number
//! of its UTF-16 units, then each in four bytes. A sequence is its length, then its elements. Padding is zero.
//!
//! | module | holds |
//! |---|---|
//! | `form` | [`Form`]: one field; `String`, `Vec`, arrays, [`WString`], [`Bounded`] |
//! | `numbers` | `Form` for numbers and `bool`, copied in bulk |
//! | `view` | [`View`]: the same fields read in place; [`Seq`], [`WStr`] |
//! | `fill` | [`Fill`]: the same fields written in place, lengths first |
//! | `writer`, `reader` | [`Writer`] and [`Reader`]: bytes and how far they are written or read |
//! | `error` | [`EncodeError`], [`DecodeError`] |

mod error;
mod fill;
pub(crate) mod form;
mod numbers;
mod reader;
mod seq;
mod view;
mod writer;
mod wstr;

pub use error::{DecodeError, DecodeFault, EncodeError, EncodeFault, Fault, FieldError, FieldPath};
pub use fill::{
    BoundFill, Carver, Elements, Field, Fill, Piece, Slice, Text, WText, WriteError, WriteFault, fill,
    sized_len,
};
#[cfg(feature = "sizes_of_values")]
#[doc(hidden)]
pub use fill::{Leaked, SizeSource, size_list};
#[doc(hidden)]
pub use form::read_one_by_one;
pub use form::{Bound, Bounded, Form, WString};
pub(crate) use reader::SLACK;
pub use reader::{Endian, Reader};
pub use seq::{Iter, Seq};
pub(crate) use view::fits_stack;
#[doc(hidden)]
pub use view::view_message;
pub use view::{BoundView, View};
pub use writer::Writer;
pub use wstr::WStr;

/// What generated code reads.
#[doc(hidden)]
pub type Decoded<T> = Result<T, Fault>;

/// What generated code writes.
#[doc(hidden)]
pub type Encoded<T> = Result<T, EncodeError>;

/// For generated code.
#[doc(hidden)]
pub mod dense {
    pub use super::fill::numbers::{end, field, values};
    pub use super::view::{array as view_array, list as view_list, one as view_one};
}
