// SPDX-License-Identifier: MIT OR Apache-2.0
//! Locks that callbacks share, and how long they block.
use std::collections::{BTreeMap, HashMap};

use super::declared::{Callback, Declared};
use super::places::Place;
use super::problem::Collector;
use super::streams::Streams;
use crate::system::System;
use crate::{CriticalSection, Hold, LockProtocol, Task, blocking};

/// A lock blocks only within a core.
pub(super) fn check(file: &Declared, places: &[Option<Place>], problems: &mut Collector) {
    let mut seen: HashMap<&str, (usize, usize)> = HashMap::new();
    for (i, (callback, place)) in file.callbacks.iter().zip(places).enumerate() {
        let Some(place) = place else { continue };
        for (resource, _) in &callback.locks {
            let (first, core) = *seen.entry(resource).or_insert((i, place.core));
            if core != place.core {
                let first = &file.callbacks[first].name;
                problems.add(
                    callback.at,
                    format!(
                        "`{resource}` is locked by callbacks `{first}` and `{}` \
                     on different cores, which has no bound: move them to one core, or let them exchange \
                     messages",
                        callback.name
                    ),
                );
            }
        }
    }
}

/// A lock that a task takes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Lock {
    pub task: usize,
    pub resource: String,
    pub length_ns: u64,
    pub protocol: LockProtocol,
}

/// All locks of a file.
pub(super) fn of(file: &Declared, streams: &Streams) -> Vec<Lock> {
    let of = |(i, callback): (usize, &Callback)| {
        let (task, protocol) = (streams.tasks(i).start, file.protocol);
        let lock = move |(resource, length_ns): &(String, u64)| Lock {
            task,
            resource: resource.clone(),
            length_ns: *length_ns,
            protocol,
        };
        callback.locks.iter().map(lock).collect::<Vec<_>>()
    };
    file.callbacks.iter().enumerate().flat_map(of).collect()
}

/// Sets what lower priorities of each core may hold each task up by their locks.
pub(super) fn block(locks: &[Lock], system: &mut System) {
    let tasks: Vec<Task> = match locks {
        [] => return,
        _ => system.callbacks.iter().map(|callback| callback.task.clone()).collect(),
    };
    let mut names: HashMap<&str, usize> = HashMap::new();
    for protocol in [LockProtocol::PriorityInheritance, LockProtocol::PriorityCeiling] {
        let mut sections: BTreeMap<usize, Vec<CriticalSection>> = BTreeMap::new();
        for lock in locks.iter().filter(|lock| lock.protocol == protocol) {
            let core = system.callbacks[lock.task].core;
            let next = names.len();
            let resource = *names.entry(&lock.resource).or_insert(next);
            // Who waits for a lock that inherits switches to its holder and back.
            let switches = match protocol {
                LockProtocol::PriorityInheritance => {
                    system.cores[core].overheads.context_switch_ns.saturating_mul(2)
                }
                LockProtocol::PriorityCeiling => 0,
            };
            let length_ns = lock.length_ns.saturating_add(switches);
            sections.entry(core).or_default().push(CriticalSection { task: lock.task, resource, length_ns });
        }
        for (core, mut sections) in sections {
            let members: Vec<usize> =
                (0..tasks.len()).filter(|i| system.callbacks[*i].core == core).collect();
            let local: Vec<Task> = members.iter().map(|i| tasks[*i].clone()).collect();
            sections
                .iter_mut()
                .for_each(|section| section.task = members.binary_search(&section.task).unwrap_or(0));
            for (i, ns) in members.iter().zip(blocking(&local, &sections, protocol)) {
                let blocking_ns = &mut system.callbacks[*i].task.blocking_ns;
                *blocking_ns = blocking_ns.saturating_add(ns);
            }
            // A holder that is demoted keeps the priority that the lock gives it.
            for section in &sections {
                let is_used = |other: &CriticalSection| {
                    other.resource == section.resource && other.task != section.task
                };
                if protocol == LockProtocol::PriorityInheritance && !sections.iter().any(is_used) {
                    continue;
                }
                let (own, holder) = (members[section.task], &local[section.task]);
                let is_own =
                    |i: &&usize| **i == own || (holder.group.is_some() && tasks[**i].group == holder.group);
                for i in members.iter().filter(is_own) {
                    if let Hold::Demoted { section_ns } = &mut system.callbacks[*i].task.hold {
                        *section_ns = section.length_ns.max(*section_ns);
                    }
                }
            }
        }
    }
}
