// SPDX-License-Identifier: MIT OR Apache-2.0
//! The macros that generated code and the derive call. They list a message's fields once; the traits follow from it.
//!
//! | macro | implements |
//! |---|---|
//! | [`cdr_form!`](crate::cdr_form) | [`Form`](crate::cdr::Form), field by field |
//! | [`plain_struct!`](crate::plain_struct) | [`Plain`](crate::Plain) with the proof that C's layout is CDR's, and `Form` |
//! | [`dense_struct!`](crate::dense_struct) | [`View`](crate::cdr::View) and [`Fill`](crate::cdr::Fill) as references |
//! | [`in_place!`](crate::in_place) | the same with a struct of getters and one of pieces |
//! | [`message!`](crate::message) | [`Message`](crate::Message) |
//! | [`stamped!`](crate::stamped) | [`HasStamp`](crate::HasStamp) |

mod dense;
mod form;
mod in_place;
mod message;
mod plain;

/// Code that only this crate's feature `sizes_of_values` has.
#[doc(hidden)]
#[macro_export]
#[cfg(feature = "sizes_of_values")]
macro_rules! sizes_of_values {
    ($($code:tt)*) => { $($code)* };
}

#[doc(hidden)]
#[macro_export]
#[cfg(not(feature = "sizes_of_values"))]
macro_rules! sizes_of_values {
    ($($code:tt)*) => {};
}
