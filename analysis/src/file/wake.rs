// SPDX-License-Identifier: MIT OR Apache-2.0
//! Who wakes the thread of a callback.
//!
//! Bounds charge each message with the sampler's work, at the highest priority, on the core of the callback that takes it
//! (`per_message`). A publisher that wakes the thread itself leaves that work out. It wakes the threads that take a topic one after the other,
//! at its own priority: the first one on its core preempts it, whatever priority the next one has. So publishers wake a thread by themselves
//! where no other thread takes its topics: then nothing is between the message and that thread, and each bound that holds with the
//! sampler holds without it.

use std::collections::BTreeMap;

use super::content::{Client, WakeUp};
use super::declared::Declared;
use super::places::Place;
use super::priorities::Thread;
use super::problem::Collector;

/// Topics that a thread's bell has places for.
const BELL_TOPICS: usize = 63;

/// Chooses who wakes each thread, in the order of the threads.
pub(super) fn choose(file: &Declared, places: &[Place], threads: &[Thread]) -> Vec<WakeUp> {
    let mut takers: BTreeMap<&str, usize> = BTreeMap::new();
    for thread in threads {
        let mut topics: Vec<&str> = topics(file, thread).collect();
        topics.sort_unstable();
        topics.dedup();
        topics.into_iter().for_each(|topic| *takers.entry(topic).or_default() += 1);
    }
    threads.iter().map(|thread| of_thread(file, places, thread, &takers)).collect()
}

/// Returns the topics that a thread takes and reads.
fn topics<'f>(file: &'f Declared, thread: &Thread) -> impl Iterator<Item = &'f str> {
    let callbacks = thread.callbacks.iter().map(|i| &file.callbacks[*i]);
    callbacks
        .flat_map(|callback| callback.topics.iter().chain(&callback.reads))
        .map(|topic| topic.value.as_str())
}

fn of_thread(file: &Declared, places: &[Place], thread: &Thread, takers: &BTreeMap<&str, usize>) -> WakeUp {
    let callbacks = || thread.callbacks.iter().map(|i| &file.callbacks[*i]);
    if file.nodes[places[thread.callbacks[0]].node].client != Client::Tautline {
        return WakeUp::Publisher;
    }
    let stated = match thread.group {
        Some(group) => file.groups[group].direct_wake.as_ref(),
        None => file.callbacks[thread.callbacks[0]].direct_wake.as_ref(),
    };
    match stated.map(|direct| direct.value) {
        Some(true) => WakeUp::Publisher,
        Some(false) => WakeUp::Sampler("the file says so"),
        // The sampler releases timers, so it is needed anyway.
        None if callbacks().any(|callback| callback.topics.is_empty()) => {
            WakeUp::Sampler("its thread has a timer")
        }
        None if topics(file, thread).count() > BELL_TOPICS => {
            WakeUp::Sampler("its thread has more than 63 topics")
        }
        None if topics(file, thread).any(|topic| takers[topic] > 1) => {
            WakeUp::Sampler("another thread takes one of its topics")
        }
        None => WakeUp::Publisher,
    }
}

/// Checks that no wake-up is stated for ROS 2's executors, which publishers always wake.
pub(super) fn check(file: &Declared, places: &[Option<Place>], problems: &Collector) {
    for (i, callback) in file.callbacks.iter().enumerate() {
        let group = callback
            .group
            .as_ref()
            .and_then(|name| file.groups.iter().find(|group| group.name == name.value));
        let stated = group.map_or(callback.direct_wake.as_ref(), |group| group.direct_wake.as_ref());
        let is_of_ros = places[i].is_some_and(|place| file.nodes[place.node].client != Client::Tautline);
        if let Some(stated) = stated.filter(|_| is_of_ros) {
            problems.at(stated.at).add(format!(
                "callback `{}` is run by an executor of ROS 2's, which publishers wake: leave out `direct_wake`",
                callback.name
            ));
        }
    }
}
