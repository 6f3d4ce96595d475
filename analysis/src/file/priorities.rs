// SPDX-License-Identifier: MIT OR Apache-2.0
//! Threads and their priorities.
use std::collections::HashSet;

use super::content::{Client, ThreadPriority};
use super::declared::{Callback, Declared, Group, Policy};
use super::places::Place;
use super::problem::Collector;
use crate::{AnalysisError, Overheads, Reservation, Task, assign};

/// One thread: a callback, or a group of them.
pub(super) struct Thread {
    pub name: String,
    pub core: usize,
    pub callbacks: Vec<usize>,
    /// Its priority while it waits.
    pub priority: Option<u8>,
    pub group: Option<usize>,
}

impl Thread {
    /// All priorities that it has at times.
    fn priorities(&self, file: &Declared) -> Vec<u8> {
        let has_several = self.group.is_some_and(|group| file.groups[group].has_priority_of_callback());
        let own = self.callbacks.iter().filter(|_| has_several);
        let own = own.filter_map(|i| file.callbacks[*i].priority.as_ref().map(|priority| priority.value));
        own.chain(self.priority).collect()
    }
}

/// Returns the priority of a group's thread while it waits: what the group states, or its ceiling.
fn of_group(file: &Declared, group: usize) -> Option<u8> {
    let group = &file.groups[group];
    if !group.has_priority_of_callback() {
        return group.priority.as_ref().map(|priority| priority.value);
    }
    let is_member = |callback: &&Callback| callback.group.as_ref().is_some_and(|of| of.value == group.name);
    file.callbacks.iter().filter(is_member).filter_map(|of| Some(of.priority.as_ref()?.value)).max()
}

/// Joins callbacks to threads, and checks groups and the priorities that the file states.
pub(super) fn threads(file: &Declared, places: &[Option<Place>], problems: &Collector) -> Vec<Thread> {
    let mut threads: Vec<Thread> = Vec::new();
    for (i, callback) in file.callbacks.iter().enumerate() {
        let name = callback.group.as_ref().map_or(&callback.name, |group| &group.value);
        let group = callback.group.as_ref().and_then(|group| {
            let found = file.groups.iter().position(|g| g.name == group.value);
            if found.is_none() {
                let hint = problems.suggestion(&group.value, file.groups.iter().map(|g| g.name.as_str()));
                let hint = if hint.is_empty() { format!(": add [groups.{}]", group.value) } else { hint };
                problems.at(group.at).add(format!(
                    "callback `{}` is in group `{}`, which is not in [groups]{hint}",
                    callback.name, group.value
                ));
            }
            found
        });
        let Some(place) = places[i] else { continue };
        let reserved = callback.reservation.as_ref().map(|_| Reservation::PRIORITY);
        let stated = reserved.or(callback.priority.as_ref().map(|priority| priority.value));
        let of_group = group.and_then(|group| of_group(file, group));
        let known = group.and_then(|g| threads.iter_mut().find(|thread| thread.group == Some(g)));
        // In a ranked group a callback's own priority is its rank, whichever the thread's is.
        let is_rank =
            |group: &Group| group.is_ranked() || group.thread_priority() == ThreadPriority::Callback;
        let stated = if group.is_some_and(|g| is_rank(&file.groups[g])) { None } else { stated };
        let Some(thread) = known else {
            let (priority, callbacks) = (of_group.or(stated), vec![i]);
            threads.push(Thread { name: name.clone(), core: place.core, callbacks, priority, group });
            continue;
        };
        let first = thread.callbacks[0];
        let fault = places[first].and_then(|other| {
            let is_ros = |place: Place| file.nodes[place.node].client != Client::Tautline;
            if (other.host, other.core) != (place.host, place.core) {
                Some("are not on one core: a group is one thread")
            } else if other.node != place.node && !(is_ros(other) && is_ros(place)) {
                Some("are not of one node: only an executor of ROS 2 (`client`) runs several in a thread")
            } else if file.nodes[other.node].executor() != file.nodes[place.node].executor() {
                Some("are of nodes that state different kinds of `executor`: one executor runs a group")
            } else {
                None
            }
        });
        if let Some(fault) = fault {
            let first = &file.callbacks[first].name;
            problems
                .at(callback.at)
                .add(format!("callbacks `{first}` and `{}` of group `{name}` {fault}", callback.name));
        }
        if let (Some(stated), Some(priority)) = (stated, thread.priority)
            && stated != priority
        {
            problems.at(callback.at).add(format!(
                "callback `{}` has priority {stated} but its group `{name}` has {priority}: a group is one thread, so \
                 state it once in [groups.{name}]",
                callback.name
            ));
        }
        thread.priority = thread.priority.or(stated);
        thread.callbacks.push(i);
    }
    for group in &file.groups {
        if !file.callbacks.iter().any(|c| c.group.as_ref().is_some_and(|g| g.value == group.name)) {
            problems.at(group.at).add(format!(
                "group `{}` has no callback: remove it, or add `group = \"{}\"` to some",
                group.name, group.name
            ));
        }
    }
    duplicates(file, &threads, problems);
    names(file, places, &threads, problems);
    threads
}

/// Checks that no callback gives its thread the name of a group: a process knows its threads by their names.
fn names(file: &Declared, places: &[Option<Place>], threads: &[Thread], problems: &Collector) {
    let key = |thread: &Thread| (thread.name.clone(), places[thread.callbacks[0]].map(|place| place.host));
    let groups: HashSet<_> = threads.iter().filter(|thread| thread.group.is_some()).map(key).collect();
    for thread in threads.iter().filter(|thread| thread.group.is_none() && groups.contains(&key(thread))) {
        let (name, at) = (&thread.name, file.callbacks[thread.callbacks[0]].at);
        problems
            .at(at)
            .add(format!("the threads of callback `{name}` and of group `{name}` have one name: rename one"));
    }
}

/// Checks that threads share a priority on a core only if both say so.
fn duplicates(file: &Declared, threads: &[Thread], problems: &Collector) {
    let agrees = |thread: &Thread| thread.callbacks.iter().any(|i| file.callbacks[*i].shares_priority);
    // Reservations have rules of their own.
    let priorities = |thread: &Thread| {
        let mut priorities = thread.priorities(file);
        priorities.retain(|priority| *priority < Reservation::PRIORITY);
        priorities
    };
    let all: Vec<Vec<u8>> = threads.iter().map(priorities).collect();
    for (i, thread) in threads.iter().enumerate() {
        let same = |other: usize| all[other].iter().copied().find(|priority| all[i].contains(priority));
        let mut earlier = (0..i).filter(|other| threads[*other].core == thread.core);
        let Some((other, priority)) = earlier.find_map(|other| Some((other, same(other)?))) else { continue };
        let other = &threads[other];
        if agrees(other) && agrees(thread) {
            continue;
        }
        let callback = &file.callbacks[thread.callbacks[0]];
        let at = callback.priority.as_ref().map_or(callback.at, |p| p.at);
        problems.at(at).add(format!(
            "`{}` and `{}` have priority {priority} on one core: give them different ones, or say `shares_priority = \
             true` in both if you mean it",
            other.name, thread.name
        ));
    }
}

/// Chooses the priorities that the file leaves open on one core, around those it states. `tasks` are the core's, and
/// `owner` their threads; `copies` are reservations of other cores that may run on it. No priority is above `highest`. Returns a warning if no
/// order meets all deadlines.
pub(super) fn choose(
    file: &Declared,
    threads: &mut [Thread],
    tasks: &[Task],
    owner: &[usize],
    copies: &[Task],
    overheads: &Overheads,
    highest: u8,
) -> Result<Option<String>, AnalysisError> {
    let stated = |i: &usize| threads[owner[*i]].priority;
    let open: Vec<usize> = (0..tasks.len()).filter(|i| stated(i).is_none()).collect();
    if open.is_empty() {
        return Ok(None);
    }
    let taken: Vec<u8> = owner.iter().flat_map(|thread| threads[*thread].priorities(file)).collect();
    let fixed = (0..tasks.len()).filter_map(|i| Some(Task { priority: stated(&i)?, ..tasks[i].clone() }));
    let fixed: Vec<Task> = fixed.chain(copies.iter().cloned()).collect();
    let is_free =
        |priority: &u8| !taken.contains(priority) && fixed.iter().all(|task| task.priority != *priority);
    let free: Vec<u8> = (1..=highest).rev().filter(is_free).collect();
    let candidates: Vec<Task> = open.iter().map(|i| tasks[*i].clone()).collect();
    let levels = u8::try_from(free.len()).unwrap_or(highest);
    let of_levels = |chosen: Vec<u8>| -> Vec<u8> {
        chosen.into_iter().map(|level| free[usize::from(levels - level)]).collect()
    };
    let (chosen, warning) = match file.policy {
        Policy::RateMonotonic => (of_levels(assign::rate_monotonic(&candidates, levels)?), None),
        Policy::DeadlineMonotonic => (of_levels(assign::deadline_monotonic(&candidates, levels)?), None),
        Policy::Audsley => match assign::audsley_beside(&candidates, &fixed, overheads, &free) {
            Ok(chosen) => (chosen, None),
            Err(error @ AnalysisError::NoAssignment { .. }) => {
                let warning = format!("{error}; priorities are deadline-monotonic instead");
                (of_levels(assign::deadline_monotonic(&candidates, levels)?), Some(warning))
            }
            Err(error) => return Err(error),
        },
    };
    for (i, priority) in open.iter().zip(chosen) {
        threads[owner[*i]].priority = Some(priority);
    }
    Ok(warning)
}
