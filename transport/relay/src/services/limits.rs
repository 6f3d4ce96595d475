// SPDX-License-Identifier: MIT OR Apache-2.0
//! Limits of a service in the domain.

use tautline_transport::{Claim, Limits};

/// Requests taken from one service before the next one's turn.
pub(super) const TURN: usize = 16;

/// Claims memory on use, because most services are called rarely, and the length of messages is unknown before they arrive.
pub(super) fn limits() -> Limits {
    Limits { claim: Claim::OnUse, ..Limits::default() }
}
