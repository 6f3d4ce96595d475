// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a service may use here.

use tautline_transport::{Claim, Limits};

/// Requests taken from one service before the next one's turn.
pub(super) const TURN: usize = 16;

/// Most services are called rarely, and the length of messages is unknown before they arrive.
pub(super) fn limits() -> Limits {
    Limits { claim: Claim::OnUse, ..Limits::default() }
}
