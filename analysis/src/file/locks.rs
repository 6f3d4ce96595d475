// SPDX-License-Identifier: MIT OR Apache-2.0
//! Locks that callbacks share, and how long they block.
use std::collections::HashMap;

use super::declared::Declared;
use super::places::Place;
use super::problem::Collector;
use super::streams::Streams;
use crate::system::Callback;
use crate::{CriticalSection, Task, blocking};

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

/// Sets what lower priorities of the core may hold each task up by their locks.
pub(super) fn block(
    file: &Declared,
    places: &[Place],
    core: usize,
    members: &[usize],
    streams: &Streams,
    callbacks: &mut [Callback],
) {
    let mut names: Vec<&str> = Vec::new();
    let mut sections = Vec::new();
    for (i, declared) in file.callbacks.iter().enumerate().filter(|(i, _)| places[*i].core == core) {
        for (name, length_ns) in &declared.locks {
            let resource = names.iter().position(|known| known == name).unwrap_or_else(|| {
                names.push(name);
                names.len() - 1
            });
            let task = members.iter().position(|member| *member == streams.tasks(i).start).unwrap_or(0);
            sections.push(CriticalSection { task, resource, length_ns: *length_ns });
        }
    }
    if sections.is_empty() {
        return;
    }
    let tasks: Vec<Task> = members.iter().map(|i| callbacks[*i].task.clone()).collect();
    for (i, ns) in members.iter().zip(blocking(&tasks, &sections, file.protocol)) {
        callbacks[*i].task.blocking_ns = ns;
    }
}
