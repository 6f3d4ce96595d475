// SPDX-License-Identifier: MIT OR Apache-2.0
//! Priorities: the threads that carry, below them the RMW's, below these the bridge's others.

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
    pub(crate) fn new(priority: u8, realtime: Realtime) -> Result<Self, RtError> {
        Ok(Priorities { highest: priority.max(3), realtime })
    }

    fn policy(&self, below: u8) -> Result<Policy, RtError> {
        match self.realtime {
            Realtime::Required => Ok(Policy::Fifo(self.highest - below)),
            Realtime::Off => tautline_rt::current_policy(),
        }
    }

    /// A thread that carries messages.
    pub(crate) fn carrying(&self, name: &str) -> ThreadBuilder {
        self.thread(name, 0)
    }

    /// A thread that does not.
    pub(crate) fn other(&self, name: &str) -> ThreadBuilder {
        self.thread(name, 2)
    }

    fn thread(&self, name: &str, below: u8) -> ThreadBuilder {
        // The RMW's calls are deep.
        let thread = ThreadBuilder::new(name).realtime(self.realtime).stack_bytes(2 << 20);
        match self.policy(below) {
            Ok(policy) => thread.policy(policy),
            Err(_) => thread,
        }
    }

    /// Sets the RMW's threads, and reads them back.
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

/// The bridge's own, and how much below the highest each is.
const OWN: [(&str, u8); 6] = [
    ("ros-in", 0),
    ("ros-out", 0),
    ("ros-services", 0),
    ("ros-control", 2),
    ("ros-here", 2),
    ("ros-there", 2),
];

impl Priorities {
    /// Watches the bridge's threads and the RMW's, all of which a flood keeps busy: those that it `began` with, and more of Fast DDS's.
    pub(crate) fn watch(self, budget: Budget, began: &[ThreadInfo]) -> Result<Guard, RtError> {
        let began: HashSet<(u32, String)> =
            began.iter().map(|thread| (thread.tid, thread.name.clone())).collect();
        let list = move || {
            let below = |thread: &ThreadInfo| match OWN.iter().find(|(own, _)| *own == thread.name) {
                Some((_, below)) => Some(*below),
                None if thread.name.starts_with("dds.") => Some(1),
                None => began.contains(&(thread.tid, thread.name.clone())).then_some(1),
            };
            let watched = |thread: ThreadInfo| Some((thread.tid, self.policy(below(&thread)?).ok()?));
            Ok(tautline_rt::threads()?.into_iter().filter_map(watched).collect())
        };
        Guard::start("ros-budget", budget, self.policy(0)?, Box::new(list))
    }
}

/// The threads of this process that were not there `before`.
pub(crate) fn started_since(before: &[ThreadInfo]) -> Result<Vec<ThreadInfo>, RtError> {
    let old: HashSet<u32> = before.iter().map(|thread| thread.tid).collect();
    let mut threads = tautline_rt::threads()?;
    threads.retain(|thread| !old.contains(&thread.tid));
    Ok(threads)
}
