// SPDX-License-Identifier: MIT OR Apache-2.0
//! What happens when processes come, go and die: threads of low priority that do what no real-time thread may wait for.
//!
//! - Each participant's [`Janitor`] sleeps until it is called, and then looks what there is to do for its ports.
//! - One participant's [`Warden`] watches all others; those of the others watch that one, to take its place. What it does for the dead
//!   is in [`burial`].

mod burial;
mod janitor;
mod warden;

pub(crate) use janitor::Janitor;
pub(crate) use warden::Warden;

use crate::error::TransportError;
use crate::graph::domain::Domain;
use tautline_rt::{Policy, Realtime, RtError, ThreadBuilder};

/// Starts recording a domain: see [`Recorder`](tautline_trace::Recorder). Tells its participants, which record from a moment later on.
///
/// # Errors
/// [`TransportError`]: there is a recorder already, or no such domain.
pub fn start_recorder(domain: u32) -> Result<tautline_trace::Recorder, TransportError> {
    crate::participant::check_domain(domain)?;
    let recorder = tautline_trace::Recorder::start(domain)?;
    if let Some(domain) = Domain::visit(domain)? {
        domain.call_all();
    }
    Ok(recorder)
}

/// Has every participant of a domain look whether there is something to do: see [`Participant::attend`](crate::Participant::attend).
///
/// # Errors
/// [`TransportError`]: no such domain.
pub fn call_all(domain: u32) -> Result<(), TransportError> {
    crate::participant::check_domain(domain)?;
    if let Some(domain) = Domain::visit(domain)? {
        domain.call_all();
    }
    Ok(())
}

/// For what no real-time thread may wait for.
pub(crate) fn low_priority_thread(name: &str) -> Result<ThreadBuilder, RtError> {
    let builder = ThreadBuilder::new(name);
    // One that is nicer already, or batch or idle, stays so: an ordinary user cannot go back.
    Ok(match tautline_rt::current_policy()? {
        Policy::Other { nice: 5.. } | Policy::Unmanaged(_) => builder.realtime(Realtime::Off),
        _ => builder.policy(Policy::Other { nice: 5 }),
    })
}
