// SPDX-License-Identifier: MIT OR Apache-2.0
//! Decides by the origins of endpoints which ones a gateway or bridge announces on its other side, and which messages it carries. So
//! a message enters each domain, network and ROS 2 graph once, however these are connected.
//!
//! On each side the announcer with the least [`Rank`] carries the messages of an endpoint; the others do not. As in path-vector
//! routing, an announcement that has passed a domain is not accepted there again, so no announcement keeps itself alive in a
//! loop; and when the best path ends, the next one is already known.

use std::collections::HashMap;
use tautline_transport::{Gid, Origin, Rank};

/// Minimum queue depth for samples of a publisher on another host: the publisher's own depth, if known, is the number of samples that
/// it keeps there, and samples arrive here in bursts.
pub const RELAYED_DEPTH: usize = 100;

/// The announcements that a gateway or bridge knows. Decides without I/O.
pub struct Transit {
    domain: u64,
    participant: u64,
    own: u128,
    crossed_ros: u8,
    goes_on: bool,
    place: String,
    rivals: HashMap<u64, Rank>,
    /// The best announcer of each tag on the far side.
    far: HashMap<u64, Rank>,
}

impl Transit {
    /// The transit between a domain, where the relay is `participant`, and a network, where it is `own`. `place` is this host's name.
    pub fn to_network(domain: u64, participant: u64, own: u128, place: &str) -> Self {
        let (rivals, far) = Default::default();
        let place = Origin::here(Gid::default(), place).place;
        Transit { domain, participant, own, crossed_ros: 0, goes_on: true, place, rivals, far }
    }

    /// The transit between a domain and a ROS 2 graph; like [`to_network`](Self::to_network).
    pub fn to_ros(domain: u64, participant: u64, own: u128, place: &str) -> Self {
        Transit { crossed_ros: 1, ..Self::to_network(domain, participant, own, place) }
    }

    /// Sets whether endpoints that other relays announce in the domain are announced, too (default: yes).
    #[must_use = "it returns the changed Transit"]
    pub fn going_on(self, goes_on: bool) -> Self {
        Transit { goes_on, ..self }
    }

    /// Sets the announcements of other relays in the domain: [`GraphSnapshot::rivals`](tautline_transport::GraphSnapshot::rivals).
    /// Forgets those of the far side.
    pub fn reset(&mut self, rivals: &HashMap<u64, Rank>) {
        self.rivals.clone_from(rivals);
        self.far.clear();
    }

    /// Adds an endpoint on the far side with its announcer, except this relay's own announcements.
    pub fn insert(&mut self, origin: &Origin, teller: u128) {
        if origin.tag != 0 {
            let rank = origin.rank(teller);
            let best = self.far.entry(origin.tag).or_insert(rank);
            *best = rank.min(*best);
        }
    }

    fn best(&self, tag: u64) -> Option<Rank> {
        self.far.get(&tag).copied()
    }

    /// The origin under which to announce `teller`'s endpoint in the domain; `None`: do not announce it, because it has passed the
    /// domain before, or there is a better announcer.
    pub fn origin_here(&self, origin: &Origin, teller: u128) -> Option<Origin> {
        let is_best = self.best(origin.tag).is_none_or(|best| best == origin.rank(teller));
        if !is_best || !origin.is_new_to(self.domain) {
            return None;
        }
        let mut told = Origin { ros: origin.ros.saturating_add(self.crossed_ros), ..origin.clone() };
        if told.place.is_empty() {
            // Not empty, because an empty place means this host.
            told.place.push_str("elsewhere");
        }
        Some(told)
    }

    /// Whether this relay carries the messages of `teller`'s endpoint into the domain.
    pub fn carries(&self, origin: &Origin, teller: u128) -> bool {
        let Some(told) = self.origin_here(origin, teller) else { return false };
        let own = told.rank(self.participant.into());
        self.rivals.get(&origin.tag).is_none_or(|rival| own < *rival)
    }

    /// The origin under which to announce an endpoint in the domain, local or not, on the far side; `None`: do not announce it.
    pub fn announced(&self, origin: &Origin) -> Option<Origin> {
        if !self.goes_on && !origin.is_here() {
            return None;
        }
        let mut announced = origin.clone().told_by(self.domain);
        if origin.is_here() {
            // No announcer is better than this one, even if another relay claims a lower rank.
            announced.place.clone_from(&self.place);
            return Some(announced);
        }
        let is_best = self.best(origin.tag).is_none_or(|best| announced.rank(self.own) < best);
        (is_best && origin.may_go_on()).then_some(announced)
    }
}

#[cfg(test)]
mod tests;
