// SPDX-License-Identifier: MIT OR Apache-2.0
//! Domains in which every process was killed, so that nobody was there to clean up.

use crate::graph::domain::remove_dead_domain;
use std::sync::Once;
use std::time::Duration;
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_rt::domain::all_shared_folders;

/// The longest time for which a process that joins its first domain removes what others left.
const SWEEP: Duration = Duration::from_millis(100);

/// Removes what is left of this user's dead domains. Once in a process, and not for longer than [`SWEEP`]: the next process goes on.
pub(crate) fn remove_dead_domains() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let end_ns = monotonic_ns().saturating_add(nanoseconds(SWEEP));
        // A directory that cannot be listed is no reason not to join.
        for (_, folder) in all_shared_folders().unwrap_or_default() {
            if monotonic_ns() >= end_ns {
                break;
            }
            remove_dead_domain(&folder);
        }
    });
}
