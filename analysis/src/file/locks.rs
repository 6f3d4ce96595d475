// SPDX-License-Identifier: MIT OR Apache-2.0
//! Locks that callbacks share, and how long they block.
use std::collections::{BTreeMap, HashMap, HashSet};

use super::content::Lock;
use super::declared::{Callback, Declared};
use super::places::Place;
use super::problem::Collector;
use super::streams::Streams;
use crate::system::System;
use crate::{CriticalSection, Hold, LockProtocol, Task, blocking};

/// Checks that the callbacks that share a lock are on one core.
pub(super) fn check(file: &Declared, places: &[Option<Place>], problems: &Collector) {
    let mut seen: HashMap<&str, (usize, usize)> = HashMap::new();
    for (i, (callback, place)) in file.callbacks.iter().zip(places).enumerate() {
        let Some(place) = place else { continue };
        for (resource, _) in &callback.locks {
            let (first, core) = *seen.entry(resource).or_insert((i, place.core));
            if core != place.core {
                let first = &file.callbacks[first].name;
                problems.at(callback.at).add(format!(
                    "`{resource}` is locked by callbacks `{first}` and `{}` on different cores, which has no bound: \
                     move them to one core, or let them exchange messages",
                    callback.name
                ));
            }
        }
    }
}

pub(super) fn of(file: &Declared, streams: &Streams) -> Vec<Lock> {
    let of = |(i, callback): (usize, &Callback)| {
        let (task, protocol) = (streams.tasks(i).start, file.protocol);
        let streams = if streams.is_join(i) { 1 } else { streams.tasks(i).len() };
        let lock = move |(resource, length_ns): &(String, u64)| Lock {
            task,
            streams,
            resource: resource.clone(),
            length_ns: *length_ns,
            protocol,
        };
        callback.locks.iter().map(lock).collect::<Vec<_>>()
    };
    file.callbacks.iter().enumerate().flat_map(of).collect()
}

/// Sets the time for which lower priorities of each core may block each task by their locks.
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
            let section = CriticalSection { task: lock.task, resource, length_ns: lock.length_ns };
            sections.entry(core).or_default().push(section);
        }
        if protocol == LockProtocol::PriorityInheritance {
            for lock in locks {
                let waits = waits(lock, locks, &tasks);
                for callback in &mut system.callbacks[lock.task..lock.task + lock.streams] {
                    callback.task.lock_waits = waits;
                }
            }
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

/// Returns how often a job may wait for inheriting locks that lower threads hold: once for each such thread, and once for each lock.
fn waits(of: &Lock, locks: &[Lock], tasks: &[Task]) -> u64 {
    let own = &tasks[of.task];
    let thread = |lock: &Lock| tasks[lock.task].group.map_or(Err(lock.task), |group| Ok(group.id));
    let is_lower = |lock: &&Lock| {
        let other = &tasks[lock.task];
        thread(lock) != thread(of)
            && (other.lowest() <= own.highest() || matches!(other.hold, Hold::Demoted { .. }))
    };
    let inherits = |lock: &&Lock| lock.protocol == LockProtocol::PriorityInheritance;
    let taken: HashSet<&str> =
        locks.iter().filter(|lock| lock.task == of.task).map(|lock| &*lock.resource).collect();
    let held =
        || locks.iter().filter(inherits).filter(is_lower).filter(|lock| taken.contains(&*lock.resource));
    let resources: HashSet<&str> = held().map(|lock| &*lock.resource).collect();
    let holders: HashSet<_> = held().map(thread).collect();
    resources.len().min(holders.len()) as u64
}
