// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which of what is on either side of a gateway or a bridge it tells of on the other one, and carries: by where things were first, so
//! that a message comes into each domain, each network and each ROS 2 graph once, however these are connected.
//!
//! On each side the least [`Rank`] of those that tell of something counts: of it the others let nothing through. It is what routers
//! between networks do by path: word that came through a domain is not believed there again, so nothing keeps itself alive in a circle;
//! and when the best way ends, the next one is known already.

use std::collections::HashMap;
use tautline_transport::{Gid, Origin, Rank};

/// How deep the queue is at least by which samples of a publisher are taken that is elsewhere: its own depth is how much it keeps there,
/// as far as that is known at all, and on the way here samples gather.
pub const RELAYED_DEPTH: usize = 100;

/// What one gateway or bridge knows: pure, and told of everything.
pub struct Transit {
    domain: u64,
    participant: u64,
    own: u128,
    crossed_ros: u8,
    goes_on: bool,
    place: String,
    rivals: HashMap<u64, Rank>,
    /// Of each tag the best that tells of it there.
    far: HashMap<u64, Rank>,
}

impl Transit {
    /// Between a domain, there as `participant`, and a network, there as `own`. `place` is what this host is called where people read
    /// it.
    pub fn to_network(domain: u64, participant: u64, own: u128, place: &str) -> Self {
        let (rivals, far) = Default::default();
        let place = Origin::here(Gid::default(), place).place;
        Transit { domain, participant, own, crossed_ros: 0, goes_on: true, place, rivals, far }
    }

    /// Between a domain and a ROS 2 graph; as [`to_network`](Self::to_network).
    pub fn to_ros(domain: u64, participant: u64, own: u128, place: &str) -> Self {
        Transit { crossed_ros: 1, ..Self::to_network(domain, participant, own, place) }
    }

    /// Whether what others tell of in the domain is announced too: it is, unless this says otherwise.
    #[must_use = "it returns the changed Transit"]
    pub fn going_on(self, goes_on: bool) -> Self {
        Transit { goes_on, ..self }
    }

    /// What others tell of in the domain: [`GraphSnapshot::rivals`](tautline_transport::GraphSnapshot::rivals). Nothing is known of
    /// the far side after that.
    pub fn look_anew(&mut self, rivals: &HashMap<u64, Rank>) {
        self.rivals.clone_from(rivals);
        self.far.clear();
    }

    /// Something is on the far side, as `teller` tells of it there; not what this one itself tells.
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

    /// How the domain is to be told of what `teller` tells on the far side; `None`: not at all, for it has been here before, or
    /// somebody else tells better of the same.
    pub fn told(&self, origin: &Origin, teller: u128) -> Option<Origin> {
        let is_best = self.best(origin.tag).is_none_or(|best| best == origin.rank(teller));
        if !is_best || !origin.is_new_to(self.domain) {
            return None;
        }
        let mut told = Origin { ros: origin.ros.saturating_add(self.crossed_ros), ..origin.clone() };
        if told.place.is_empty() {
            // It is not here, whatever others leave out.
            told.place.push_str("elsewhere");
        }
        Some(told)
    }

    /// Whether what it sends comes into the domain here.
    pub fn carries(&self, origin: &Origin, teller: u128) -> bool {
        let Some(told) = self.told(origin, teller) else { return false };
        let own = told.rank(self.participant.into());
        self.rivals.get(&origin.tag).is_none_or(|rival| own < *rival)
    }

    /// How the far side is to be told of what the domain has, be it there or told by another gateway or bridge; `None`: not at all.
    pub fn announced(&self, origin: &Origin) -> Option<Origin> {
        if !self.goes_on && !origin.is_here() {
            return None;
        }
        let mut announced = origin.clone().told_by(self.domain);
        if origin.is_here() {
            // Whatever others claim: nobody tells better of it.
            announced.place.clone_from(&self.place);
            return Some(announced);
        }
        let is_best = self.best(origin.tag).is_none_or(|best| announced.rank(self.own) < best);
        (is_best && origin.may_go_on()).then_some(announced)
    }
}

#[cfg(test)]
mod tests;
