// SPDX-License-Identifier: MIT OR Apache-2.0
//! Handles processes that join, leave and die, in threads of low priority: no real-time thread may wait for this work.
//!
//! - Each participant's [`Janitor`] sleeps until it is called, and then does what is necessary for its ports.
//! - One participant's [`Warden`] watches all other participants. The wardens of the others watch this one, to take its place. The
//!   cleanup after a dead participant is in [`dead_participant`].

mod dead_participant;
mod janitor;
mod warden;

pub(crate) use janitor::Janitor;
pub(crate) use warden::Warden;

use crate::error::TransportError;
use crate::graph::domain::{Domain, remove_dead_domain};
use std::sync::Once;
use std::time::Duration;
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_rt::domain::all_shared_folders;
use tautline_rt::{Policy, Realtime, RtError, ThreadBuilder};

/// Starts recording a domain: see [`Recorder`](tautline_trace::Recorder). Notifies its participants, which start to record a moment
/// later.
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

/// Makes every participant of a domain check whether there is something to do: see
/// [`Participant::attend`](crate::Participant::attend).
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

/// So long a process removes what others left at most, when it joins its first domain.
const SWEEP: Duration = Duration::from_millis(100);

/// Removes what is left of this user's domains in which every process was killed, so that nobody was there to clean up. Once in a
/// process, and not for longer than [`SWEEP`]: the next process goes on.
pub(crate) fn remove_dead_domains() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let end_ns = monotonic_ns().saturating_add(nanoseconds(SWEEP));
        // What cannot be listed is not this process's trouble.
        for (_, folder) in all_shared_folders().unwrap_or_default() {
            if monotonic_ns() >= end_ns {
                break;
            }
            remove_dead_domain(&folder);
        }
    });
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
