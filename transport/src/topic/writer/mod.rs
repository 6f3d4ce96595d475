// SPDX-License-Identifier: MIT OR Apache-2.0
//! A publisher below its user: the setup half ([`core`]), and what the thread that publishes works with ([`sender`], [`history`]).

pub(crate) mod core;
pub(crate) mod history;
pub(crate) mod sender;
