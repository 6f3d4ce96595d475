// SPDX-License-Identifier: MIT OR Apache-2.0
//! Threads for work that no real-time thread may wait for: the janitor, the warden, the watcher of the graph.

use tautline_rt::{Policy, Realtime, RtError, ThreadBuilder};

/// A thread of nice 5, or nicer if this one is.
pub(crate) fn low_priority_thread(name: &str) -> Result<ThreadBuilder, RtError> {
    let builder = ThreadBuilder::new(name);
    // One that is nicer already, or batch or idle, stays so: an ordinary user cannot go back.
    Ok(match tautline_rt::current_policy()? {
        Policy::Other { nice: 5.. } | Policy::Unmanaged(_) => builder.realtime(Realtime::Off),
        _ => builder.policy(Policy::Other { nice: 5 }),
    })
}
