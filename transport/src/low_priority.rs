// SPDX-License-Identifier: MIT OR Apache-2.0
//! Threads for work that no real-time thread may wait for: the janitor, the warden, the watcher of the graph.

use tautline_rt::{Policy, Realtime, RtError, ThreadBuilder};

/// The builder of a thread with nice 5, or with this thread's policy if that is nicer.
pub(crate) fn low_priority_thread(name: &str) -> Result<ThreadBuilder, RtError> {
    let builder = ThreadBuilder::new(name);
    // A nicer, batch or idle policy is kept: an unprivileged user cannot change it back.
    Ok(match tautline_rt::current_policy()? {
        Policy::Other { nice: 5.. } | Policy::Unmanaged(_) => builder.realtime(Realtime::Off),
        _ => builder.policy(Policy::Other { nice: 5 }),
    })
}
