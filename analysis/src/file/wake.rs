// SPDX-License-Identifier: MIT OR Apache-2.0
//! Who wakes the thread of a callback.
//!
//! Bounds charge each message with the sampler's work, at the highest priority, on the core of the callback that takes it
//! (`per_message`). A publisher that wakes the thread itself leaves that work out and adds none: it makes one futex wake for each
//! process that sleeps, of the sampler or of the one thread that is concerned; and where a message concerns several threads of a process,
//! the sampler still wakes them, so that they run in the order of their priorities. Every other task keeps what delays it. So each bound
//! that holds with the sampler holds without it, and what decides is whether a thread gains by it, and whether it has a bell.
use super::Client;
use super::declared::Declared;
use super::places::Place;
use super::priorities::Thread;

/// Topics that a thread's bell has places for.
const BELL_TOPICS: usize = 63;
/// Half of the threads of a process that can have a bell: the program may have others.
const BELLS: usize = 128;

/// Who wakes the thread of a callback for a message: see docs/wake-ups.md.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WakeUp {
    /// The publisher.
    Publisher,
    /// The sampler of its node, for this reason.
    Sampler(&'static str),
}

/// Of each thread, in their order.
pub(super) fn choose(file: &Declared, places: &[Place], threads: &[Thread]) -> Vec<WakeUp> {
    let node = |thread: &Thread| places[thread.callbacks[0]].node;
    let mut chosen: Vec<WakeUp> =
        threads.iter().map(|thread| of_thread(file, node(thread), thread)).collect();
    for index in 0..file.nodes.len() {
        let of_node = threads.iter().zip(&mut chosen).filter(|(thread, _)| node(thread) == index);
        let direct = of_node.filter(|(_, wake_up)| **wake_up == WakeUp::Publisher);
        let unstated = direct.filter(|(thread, _)| stated(file, thread).is_none());
        unstated
            .skip(BELLS)
            .for_each(|(_, wake_up)| *wake_up = WakeUp::Sampler("its node has too many threads"));
    }
    chosen
}

fn stated(file: &Declared, thread: &Thread) -> Option<bool> {
    match thread.group {
        Some(group) => file.groups[group].direct_wake,
        None => file.callbacks[thread.callbacks[0]].direct_wake.as_ref().map(|direct| direct.value),
    }
}

fn of_thread(file: &Declared, node: usize, thread: &Thread) -> WakeUp {
    let callbacks = || thread.callbacks.iter().map(|i| &file.callbacks[*i]);
    let topics: usize = callbacks().map(|callback| callback.topics.len() + callback.reads.len()).sum();
    if file.nodes[node].client != Client::Tautline {
        return WakeUp::Sampler("an executor of ROS 2 runs it");
    }
    match stated(file, thread) {
        Some(true) => WakeUp::Publisher,
        Some(false) => WakeUp::Sampler("the file says so"),
        // Which the sampler releases: it is there for it anyway.
        None if callbacks().any(|callback| callback.topics.is_empty()) => {
            WakeUp::Sampler("its thread has a timer")
        }
        None if topics > BELL_TOPICS => WakeUp::Sampler("its thread has more than 63 topics"),
        None => WakeUp::Publisher,
    }
}
