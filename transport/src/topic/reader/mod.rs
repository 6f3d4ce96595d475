// SPDX-License-Identifier: MIT OR Apache-2.0
//! A subscription below its user: the setup half ([`core`]), where it gets a publisher's samples ([`source`]), and what the thread that
//! takes works with ([`receiver`], [`borrowed`]).

pub(crate) mod borrowed;
pub(crate) mod core;
pub(crate) mod receiver;
pub(crate) mod source;
