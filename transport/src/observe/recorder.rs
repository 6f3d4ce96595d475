// SPDX-License-Identifier: MIT OR Apache-2.0
//! Starts a recording, and makes the participants of a domain check whether there is something to do.

use crate::error::TransportError;
use crate::graph::domain::{Domain, check_domain};

/// Starts recording a domain: see [`Recorder`](tautline_trace::Recorder). Notifies its participants, which start to record a moment
/// later.
///
/// # Errors
/// [`TransportError`]: there is a recorder already, or no such domain.
pub fn start_recorder(domain: u32) -> Result<tautline_trace::Recorder, TransportError> {
    check_domain(domain)?;
    let recorder = tautline_trace::Recorder::start(domain)?;
    if let Some(domain) = Domain::visit(domain)? {
        domain.call_all();
    }
    Ok(recorder)
}

/// Makes every participant of a domain check whether there is something to do: see
/// [`Participant::attend`](crate::Participant::attend).
///
/// # Errors
/// [`TransportError`]: no such domain.
pub fn call_all(domain: u32) -> Result<(), TransportError> {
    check_domain(domain)?;
    if let Some(domain) = Domain::visit(domain)? {
        domain.call_all();
    }
    Ok(())
}
