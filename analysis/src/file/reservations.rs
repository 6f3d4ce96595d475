// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks with a reservation: which entries of the file are allowed for them, and the time that they take from every
//! core that they may run on.
use super::content::{Client, CoreEntry};
use super::declared::{Callback as Declaration, Declared};
use super::places::Place;
use super::problem::Collector;
use super::streams::Streams;
use crate::Reservation;
use crate::system::Callback;

pub(super) fn check(file: &Declared, places: &[Option<Place>], streams: &Streams, problems: &Collector) {
    for (i, callback) in file.callbacks.iter().enumerate() {
        let name = &callback.name;
        let Some(reservation) = &callback.reservation else {
            if let Some(at) = callback.floats {
                problems.at(at).add(format!(
                    "callback `{name}` is on any core, which only one with a `reservation` may be: name its core"
                ));
            }
            continue;
        };
        let problem = |what: &str| {
            problems.at(reservation.at).add(format!("callback `{name}` has a `reservation`, {what}"));
        };
        if callback.priority.is_some() || callback.shares_priority {
            problem("which is above every priority: leave out `priority` and `shares_priority`");
        }
        if callback.group.is_some() {
            problem("but shares its thread: give it one of its own, without `group`");
        }
        if callback.holds().is_some() {
            problem("to which the kernel holds it: leave out `overrun`");
        }
        if !callback.locks.is_empty() {
            problem(
                "but takes locks: who waits for one while the reservation is used up has no bound; leave them out",
            );
        }
        if callback.non_preemptive.is_some() {
            problem("whose end preempts everything: leave out `non_preemptive`");
        }
        if callback.all.is_some() || streams.tasks(i).len() > 1 {
            problem(
                "but is reached in several ways, which has no bound: let one publisher trigger it, by one topic",
            );
        }
        if places[i].is_some_and(|place| file.nodes[place.node].client != Client::Tautline) {
            problem("but is run by an executor of ROS 2's: leave it out");
        }
        let same_host = |(other, place): &(&Declaration, &Option<Place>)| {
            other.reservation.is_some() && place.zip(places[i]).is_some_and(|(one, two)| one.host == two.host)
        };
        let before: Vec<_> = file.callbacks[..i].iter().zip(&places[..i]).filter(same_host).collect();
        let floats = |callback: &Declaration| callback.floats.is_some();
        if let Some((other, _)) = before.iter().find(|(other, _)| floats(other) != floats(callback)) {
            problem(&format!(
                "as `{}` on its host, but only one of both is on any core, where they may wait for each other: say `core = \"any\"` in \
                 both, or in none",
                other.name
            ));
        }
        let on_core = |(other, place): &&(&Declaration, &Option<Place>)| {
            !floats(other) && place.map(|of| of.core) == places[i].map(|of| of.core)
        };
        if let Some((other, _)) = before.iter().find(on_core).filter(|_| !floats(callback)) {
            problem(&format!(
                "as `{}` on its core: there may be one on a core, for they wait for each other",
                other.name
            ));
        }
        let cores = places[i].map_or(0, |place| file.hosts[place.host].cores.len());
        if floats(callback) && before.iter().filter(|(other, _)| floats(other)).count() >= cores {
            problem(
                "as many more on its host, which has fewer cores: they would wait for each other; leave out one",
            );
        }
    }
}

/// Adds copies of a callback, after all others, on the other cores of its host: a reservation that may run on any core takes time from each
/// of them, at most all that it has.
pub(super) fn copy(name: &str, task: usize, cores: &[CoreEntry], callbacks: &mut Vec<Callback>) {
    let own = callbacks[task].clone();
    let others =
        (0..cores.len()).filter(|core| cores[*core].host == cores[own.core].host && *core != own.core);
    callbacks.extend(others.map(|core| {
        let mut copy = Callback { core, copy_of: Some(task), ..own.clone() };
        copy.task.priority = Reservation::PRIORITY;
        copy.task.name = format!("{name} (core {})", cores[core].number);
        copy
    }));
}
