// SPDX-License-Identifier: MIT OR Apache-2.0
//! Priorities: the threads that carry messages are highest, the RMW's one below, the bridge's other threads two below.

use std::collections::HashSet;
use tautline_relay::{Budget, Guard};
use tautline_rt::{Policy, Realtime, RtError, ThreadBuilder, ThreadInfo};

/// The bridge's priorities.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Priorities {
    highest: u8,
    realtime: Realtime,
}

impl Priorities {
    pub(crate) fn new(priority: u8, realtime: Realtime) -> Self {
        Priorities { highest: priority.max(3), realtime }
    }

    fn policy(&self, below: u8) -> Result<Policy, RtError> {
        match self.realtime {
            Realtime::Required => Ok(Policy::Fifo(self.highest - below)),
            Realtime::Off => tautline_rt::current_policy(),
        }
    }

    /// Builds one of the bridge's own threads.
    pub(crate) fn thread(&self, name: &str) -> ThreadBuilder {
        // Calls into the RMW need a deep stack.
        let thread = ThreadBuilder::new(name).realtime(self.realtime).stack_bytes(2 << 20);
        match self.policy(own(name).unwrap_or(LOWEST)) {
            Ok(policy) => thread.policy(policy),
            Err(_) => thread,
        }
    }

    /// Sets the policy of the RMW's threads and reads it back.
    pub(crate) fn set(&self, threads: &[ThreadInfo]) -> Result<(), RtError> {
        if self.realtime == Realtime::Required {
            let policy = self.policy(1)?;
            for thread in threads {
                tautline_rt::set_policy_of(thread.tid, policy)?;
            }
        }
        Ok(())
    }
}

/// Priority levels of the bridge's own threads below the highest.
fn own(name: &str) -> Option<u8> {
    match name {
        "ros-in" | "ros-out" | "ros-services" => Some(0),
        "ros-control" | "ros-here" | "ros-there" => Some(LOWEST),
        _ => None,
    }
}

const LOWEST: u8 = 2;

impl Priorities {
    /// Watches all threads that a flood keeps busy: the bridge's, those that it `began` with, and later ones of Fast DDS.
    pub(crate) fn watch(self, budget: Budget, began: &[ThreadInfo]) -> Result<Guard, RtError> {
        let began: HashSet<(u32, String)> =
            began.iter().map(|thread| (thread.tid, thread.name.clone())).collect();
        let list = move || {
            let below = |thread: &ThreadInfo| match own(&thread.name) {
                Some(below) => Some(below),
                None if thread.name.starts_with("dds.") => Some(1),
                None => began.contains(&(thread.tid, thread.name.clone())).then_some(1),
            };
            let watched = |thread: ThreadInfo| Some((thread.tid, self.policy(below(&thread)?).ok()?));
            Ok(tautline_rt::threads()?.into_iter().filter_map(watched).collect())
        };
        Guard::start("ros-budget", budget, self.policy(0)?, Box::new(list))
    }
}

/// The threads of this process that are not in `before`.
pub(crate) fn started_since(before: &[ThreadInfo]) -> Result<Vec<ThreadInfo>, RtError> {
    let old: HashSet<u32> = before.iter().map(|thread| thread.tid).collect();
    let mut threads = tautline_rt::threads()?;
    threads.retain(|thread| !old.contains(&thread.tid));
    Ok(threads)
}
