// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where something was first, and how word of it came here: what keeps gateways and bridges, which pass on what others have, from
//! passing anything on twice or in circles.

use super::log::hash_of_bytes;
use super::record::is_token_char;
use crate::topic::header::Gid;
use serde::{Deserialize, Serialize};

/// Where an end or a node was first, and the domains by which word of it came.
///
/// Two ways may lead here, of a ring for example: what has the same tag is the same end, and of those that tell of it the one with the
/// least [`Rank`] counts. Word that has been here before is not believed: so there are no circles, however hosts are connected.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Origin {
    /// Tells it from everything else: [`Gid::tag`] of its gid where it is. 0: not known; it is taken for one of its own.
    #[serde(skip_serializing_if = "is_zero", default)]
    pub tag: u64,
    /// The domains that told others of it, the first one first: [`Participant::domain_id`](crate::Participant::domain_id). At most
    /// [`MOST_HOPS`](Self::MOST_HOPS).
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub path: Vec<u64>,
    /// How often it crossed a ROS 2 graph, which keeps no sequence numbers.
    #[serde(skip_serializing_if = "is_no", default)]
    pub ros: u8,
    /// Where it is, for people: a host's name, or `ros` and the domain. Letters, digits and underscores; may be empty.
    #[serde(skip_serializing_if = "String::is_empty", default)]
    pub place: String,
}

fn is_zero(value: &u64) -> bool {
    *value == 0
}

fn is_no(value: &u8) -> bool {
    *value == 0
}

/// How good word of something is: less is better. Ordered by how many domains it came through, how often over ROS, who tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Rank {
    /// Domains that it came through.
    pub hops: usize,
    /// How often it crossed a ROS 2 graph.
    pub ros: u8,
    /// Who tells: any number, by which equals are told apart.
    pub teller: u128,
}

impl Origin {
    /// Longest path: what has come further is not passed on.
    pub const MOST_HOPS: usize = 8;
    /// Longest [`place`](Self::place) in bytes.
    pub const MOST_PLACE_BYTES: usize = 40;

    /// Of something that is here: `place` is cut, and what no place can have becomes an underscore.
    pub fn here(gid: Gid, place: &str) -> Self {
        let place = place.chars().take(Self::MOST_PLACE_BYTES);
        let place = place.map(|c| if is_token_char(c) { c } else { '_' }).collect();
        Origin { tag: gid.tag(), place, ..Origin::default() }
    }

    /// The tag of something that has no gid but this text: as [`Gid::tag`].
    pub fn tag_of(text: &str) -> u64 {
        hash_of_bytes(text.as_bytes()).max(1)
    }

    /// As `domain` tells others of it.
    #[must_use = "it returns the changed origin"]
    pub fn told_by(mut self, domain: u64) -> Self {
        self.path.push(domain);
        self
    }

    /// Whether it is of the domain that has it.
    pub fn is_here(&self) -> bool {
        self.path.is_empty() && self.ros == 0 && self.place.is_empty()
    }

    /// Whether `domain` may believe it: it has not been there, and has not come too far.
    pub fn is_new_to(&self, domain: u64) -> bool {
        self.path.len() <= Self::MOST_HOPS && !self.path.contains(&domain)
    }

    /// Whether a domain that has it may tell others.
    pub fn may_go_on(&self) -> bool {
        self.path.len() < Self::MOST_HOPS
    }

    /// How good this is as `teller` tells it.
    pub fn rank(&self, teller: u128) -> Rank {
        Rank { hops: self.path.len(), ros: self.ros, teller }
    }

    /// Whether it is one that an honest process or host writes.
    pub fn is_valid(&self) -> bool {
        self.path.len() <= Self::MOST_HOPS
            && self.place.len() <= Self::MOST_PLACE_BYTES
            && self.place.chars().all(is_token_char)
    }
}

impl Gid {
    /// A number that stands for it: 64 bits of a hash (FNV-1a), never 0. 0 stands for the gid of zeros, which is nobody's.
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
