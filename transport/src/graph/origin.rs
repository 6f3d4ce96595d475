// SPDX-License-Identifier: MIT OR Apache-2.0
//! The origin of an entity, and the path of its announcements. With it gateways and bridges, which forward announcements, avoid
//! duplicates and loops.

use crate::graph::log::hash_of_bytes;
use crate::memory::header::Gid;
use crate::names::is_token_char;
use serde::{Deserialize, Serialize};

/// The origin of an endpoint or a node, and the domains that its announcement has passed.
///
/// Two paths may lead to this domain, for example in a ring. Entities with the same tag are the same entity, and of its announcers the
/// one with the least [`Rank`] counts. An announcement that has been in this domain before is ignored. So there are no loops, however
/// hosts are connected.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Origin {
    /// Identifies the entity: [`Gid::tag`] of its gid at its origin. 0: not known; it counts as an entity of its own.
    #[serde(skip_serializing_if = "is_zero", default)]
    pub tag: u64,
    /// The domains that announced it, the first one first: [`Participant::domain_id`](crate::Participant::domain_id). At most
    /// [`MOST_HOPS`](Self::MOST_HOPS).
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub path: Vec<u64>,
    /// How often it crossed a ROS 2 graph, which keeps no sequence numbers.
    #[serde(skip_serializing_if = "is_no", default)]
    pub ros: u8,
    /// Its location, for display: a host's name, or `ros` and the domain. Letters, digits and underscores; may be
    /// empty.
    #[serde(skip_serializing_if = "String::is_empty", default)]
    pub place: String,
}

fn is_zero(value: &u64) -> bool {
    *value == 0
}

fn is_no(value: &u8) -> bool {
    *value == 0
}

/// The rank of an announcement: less is better. Ordered by the number of domains on its path, then by how often it crossed
/// ROS, then by announcer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Rank {
    /// Domains on its path.
    pub hops: usize,
    /// How often it crossed a ROS 2 graph.
    pub ros: u8,
    /// The announcer: any number that distinguishes announcements that are otherwise equal.
    pub teller: u128,
}

impl Origin {
    /// Longest path: announcements with a longer path are not forwarded.
    pub const MOST_HOPS: usize = 8;
    /// Longest [`place`](Self::place) in bytes.
    pub const MOST_PLACE_BYTES: usize = 40;

    /// The origin of a local entity. `place` is truncated, and characters that are not allowed in it become
    /// underscores.
    pub fn here(gid: Gid, place: &str) -> Self {
        let place = place.chars().take(Self::MOST_PLACE_BYTES);
        let place = place.map(|c| if is_token_char(c) { c } else { '_' }).collect();
        Origin { tag: gid.tag(), place, ..Origin::default() }
    }

    /// The tag of an entity that has this text instead of a gid: like [`Gid::tag`].
    pub fn tag_of(text: &str) -> u64 {
        hash_of_bytes(text.as_bytes()).max(1)
    }

    /// This origin as `domain` announces it.
    #[must_use = "it returns the changed origin"]
    pub fn told_by(mut self, domain: u64) -> Self {
        self.path.push(domain);
        self
    }

    /// Whether the entity belongs to the domain that has this origin.
    pub fn is_here(&self) -> bool {
        self.path.is_empty() && self.ros == 0 && self.place.is_empty()
    }

    /// Whether `domain` may accept it: the path does not contain `domain`, and is not too long.
    pub fn is_new_to(&self, domain: u64) -> bool {
        self.path.len() <= Self::MOST_HOPS && !self.path.contains(&domain)
    }

    /// Whether a domain that has it may announce it to others.
    pub fn may_go_on(&self) -> bool {
        self.path.len() < Self::MOST_HOPS
    }

    /// The rank of this origin when `teller` announces it.
    pub fn rank(&self, teller: u128) -> Rank {
        Rank { hops: self.path.len(), ros: self.ros, teller }
    }

    /// Whether it is well-formed.
    pub fn is_valid(&self) -> bool {
        self.path.len() <= Self::MOST_HOPS
            && self.place.len() <= Self::MOST_PLACE_BYTES
            && self.place.chars().all(is_token_char)
    }
}

impl Gid {
    /// A number that represents this gid: 64 bits of a hash (FNV-1a), never 0. 0 represents the gid of zeros, which no
    /// endpoint has.
    pub fn tag(&self) -> u64 {
        if *self == Gid::default() { 0 } else { hash_of_bytes(&self.0).max(1) }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn shorter_ways_are_better_and_circles_are_seen() {
        let origin = Origin::here(Gid([7; 16]), "robot-1.lan");
        assert_eq!((&*origin.place, origin.is_new_to(1), origin.may_go_on()), ("robot_1_lan", true, true));
        let told = origin.clone().told_by(1);
        assert!(!told.is_new_to(1) && told.is_new_to(2) && told.tag == origin.tag);
        assert!(origin.rank(9) < told.rank(1) && told.rank(1) < told.rank(2));
        let over_ros = Origin { ros: 1, ..told.clone() };
        assert!(told.rank(2) < over_ros.rank(1) && over_ros.rank(1) < told.clone().told_by(2).rank(0));
        let far = (0..Origin::MOST_HOPS as u64).fold(origin, Origin::told_by);
        assert!(far.is_new_to(99) && !far.may_go_on() && far.is_valid());
        assert!(!far.told_by(99).is_valid());
        let odd = Origin { place: "\u{1b}[2J".into(), ..Origin::default() };
        assert!(!odd.is_valid());
    }
}
