// SPDX-License-Identifier: MIT OR Apache-2.0
//! Gateways and bridges in any arrangement, which update in any order.

use super::*;
use crate::mirror::{Action, Far, InKey, Mirror as Decider, Side};
use crate::rules::Rules;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use std::collections::{BTreeMap, BTreeSet};
use tautline_transport::{EndpointKind, Qos, TopicEndpoint, TopicType};

/// A domain, another space, and whether that is ROS.
type Link = (usize, usize, bool);

/// A domain, a network or a ROS 2 graph: its own endpoints, and announcements by announcer.
#[derive(Default)]
struct Space {
    natives: BTreeMap<u64, Origin>,
    told: BTreeMap<(usize, u64), Origin>,
}

/// Whether a native is a publisher; otherwise it is a subscription to the same topic.
fn is_publisher(tag: u64) -> bool {
    tag % 2 == 1
}

/// An endpoint's GID in a space, as announced by `teller`.
fn gid(space: usize, teller: u128, tag: u64) -> Gid {
    let mut gid = [0; 16];
    gid[..8].copy_from_slice(&tag.to_le_bytes());
    (gid[8], gid[9]) = (space as u8, teller as u8);
    Gid(gid)
}

fn end(space: usize, teller: u128, origin: &Origin) -> TopicEndpoint {
    TopicEndpoint {
        kind: if is_publisher(origin.tag) { EndpointKind::Publisher } else { EndpointKind::Subscription },
        topic: "/x".into(),
        topic_type: TopicType::new("a/msg/B").with_hash("RIHS01_"),
        gid: gid(space, teller, origin.tag),
        qos: Qos::default(),
        node: None,
        pid: None,
        is_remote: teller != 0,
        is_own: false,
        origin: origin.clone(),
        teller: None,
    }
}

/// Between a domain and another space, with its state of the last update.
struct Mirror {
    domain: usize,
    far: usize,
    is_bridge: bool,
    lives: bool,
    carries: BTreeSet<u64>,
    announces: BTreeSet<u64>,
    decider: Decider,
    writers: BTreeSet<Gid>,
    is_taking: bool,
    inward: BTreeMap<InKey, BTreeSet<Gid>>,
}

impl Mirror {
    /// A mirror that has just started.
    fn new(domain: usize, far: usize, is_bridge: bool) -> Self {
        let side = if is_bridge { Side::Ros } else { Side::Network };
        let decider = Decider::new(side, Rules { auto: true, ..Rules::default() });
        let (carries, announces, writers, inward) = Default::default();
        let (lives, is_taking) = (true, false);
        Mirror { domain, far, is_bridge, lives, carries, announces, decider, writers, is_taking, inward }
    }

    fn act(&mut self, actions: Vec<Action>) {
        for action in actions {
            match action {
                Action::OpenWriter(_, gid, ..) => assert!(self.writers.insert(gid)),
                Action::CloseWriter(_, gid) => assert!(self.writers.remove(&gid)),
                Action::StartOut(..) => self.is_taking = true,
                Action::StopOut(..) => assert!(std::mem::take(&mut self.is_taking)),
                Action::StartIn(key, now) | Action::AskAgain(key, now) | Action::ChangeIn(key, now) => {
                    self.inward.insert(key, now.publishers.into_keys().collect());
                }
                Action::StopIn(key) => assert!(self.inward.remove(&key).is_some()),
            }
        }
    }

    /// Whether a message under this endpoint's GID in a space is forwarded, and where to.
    fn passes_on(&self, space: usize, gid: &Gid) -> Option<usize> {
        let goes_out = self.domain == space && self.is_taking && self.writers.contains(gid);
        let comes_in = self.far == space && self.inward.values().any(|class| class.contains(gid));
        goes_out.then_some(self.far).or(comes_in.then_some(self.domain))
    }
}

struct World {
    spaces: Vec<Space>,
    mirrors: Vec<Mirror>,
    next_tag: u64,
}

impl World {
    fn new(spaces: usize, links: &[Link]) -> Self {
        let mirror = |&(domain, far, is_bridge): &Link| Mirror::new(domain, far, is_bridge);
        let spaces = (0..spaces).map(|_| Space::default()).collect();
        World { spaces, mirrors: links.iter().map(mirror).collect(), next_tag: 1 }
    }

    fn add(&mut self, space: usize) -> u64 {
        let tag = self.next_tag;
        self.next_tag += 1;
        self.spaces[space].natives.insert(tag, Origin { tag, ..Origin::default() });
        tag
    }

    /// A mirror reads both sides and updates its announcements. Returns whether anything changed.
    fn look(&mut self, at: usize) -> bool {
        let Mirror { domain, far, is_bridge, .. } = self.mirrors[at];
        let id = at as u128 + 1;
        let mut transit = match is_bridge {
            true => Transit::to_ros(domain as u64, id as u64, id, ""),
            false => Transit::to_network(domain as u64, id as u64, id, ""),
        };
        // Everything on a side, without this mirror's announcements.
        let seen = |space: &Space| -> Vec<(Origin, u128)> {
            let natives = space.natives.values().map(|origin| (origin.clone(), 0));
            let told = space.told.iter().filter(|((by, _), _)| *by != at);
            natives.chain(told.map(|((by, _), origin)| (origin.clone(), *by as u128 + 1))).collect()
        };
        let (here, there) = (seen(&self.spaces[domain]), seen(&self.spaces[far]));
        let mut rivals = HashMap::new();
        for (origin, teller) in here.iter().filter(|(_, teller)| *teller != 0) {
            let rank = origin.rank(*teller);
            let best = rivals.entry(origin.tag).or_insert(rank);
            *best = rank.min(*best);
        }
        transit.reset(&rivals);
        there.iter().for_each(|(origin, teller)| transit.insert(origin, *teller));
        let told: BTreeMap<u64, Origin> = (there.iter())
            .filter_map(|(origin, teller)| Some((origin.tag, transit.origin_here(origin, *teller)?)))
            .collect();
        let carries: BTreeSet<u64> = (there.iter())
            .filter(|(origin, teller)| transit.carries(origin, *teller))
            .map(|(origin, _)| origin.tag)
            .collect();
        // The best announcements in the domain, if they are not this mirror's.
        let mut best = BTreeMap::<u64, (Rank, Origin)>::new();
        for (origin, teller) in &here {
            let rank = origin.rank(*teller);
            if best.get(&origin.tag).is_none_or(|(best, _)| rank < *best) {
                best.insert(origin.tag, (rank, origin.clone()));
            }
        }
        best.retain(|tag, (rank, _)| {
            rank.teller == 0 || told.get(tag).is_none_or(|own| own.rank(id) > *rank)
        });
        let announced: BTreeMap<u64, Origin> =
            (best.iter()).filter_map(|(tag, (_, origin))| Some((*tag, transit.announced(origin)?))).collect();
        let here: Vec<TopicEndpoint> = (best.iter())
            .filter(|(tag, _)| !is_publisher(**tag) || announced.contains_key(tag))
            .map(|(_, (rank, origin))| end(domain, rank.teller, origin))
            .collect();
        let there: Vec<(TopicEndpoint, bool)> = (there.iter())
            .filter(|(origin, teller)| {
                is_publisher(origin.tag) || transit.origin_here(origin, *teller).is_some()
            })
            .map(|(origin, teller)| (end(far, *teller, origin), transit.carries(origin, *teller)))
            .collect();
        let there: Vec<Far> = there.iter().map(|(end, comes_in)| (end, *comes_in)).collect();
        let mirror = &mut self.mirrors[at];
        let actions = mirror.decider.update(&here, &there);
        mirror.act(actions);
        let announces = announced.keys().copied().collect();
        let mut changed = mirror.carries != carries || mirror.announces != announces;
        (mirror.carries, mirror.announces) = (carries, announces);
        changed |= self.spaces[domain].say(at, told);
        changed | self.spaces[far].say(at, announced)
    }

    /// All mirrors update, in any order, until nothing changes.
    fn settle(&mut self, random: &mut SmallRng) {
        for _ in 0..10_000 {
            for _ in 0..self.mirrors.len() {
                let at = random.random_range(0..self.mirrors.len());
                if self.mirrors[at].lives {
                    self.look(at);
                }
            }
            let living: Vec<usize> = (0..self.mirrors.len()).filter(|at| self.mirrors[*at].lives).collect();
            if !living.into_iter().fold(false, |changed, at| changed | self.look(at)) {
                return;
            }
        }
        panic!("it does not come to rest");
    }

    fn kill(&mut self, at: usize) {
        self.mirrors[at].lives = false;
        self.spaces.iter_mut().for_each(|space| space.told.retain(|(by, _), _| *by != at));
    }

    /// How often a message arrives in each space, with the present mirrors.
    fn arrivals(&self, tag: u64) -> Vec<usize> {
        let home = self.spaces.iter().position(|space| space.natives.contains_key(&tag));
        let mut arrived = vec![0; self.spaces.len()];
        let mut waiting: Vec<(usize, u128)> = home.map(|home| (home, 0)).into_iter().collect();
        while let Some((space, teller)) = waiting.pop() {
            arrived[space] += 1;
            assert!(arrived[space] < 10, "a message goes in circles");
            for (at, mirror) in self.mirrors.iter().enumerate().filter(|(_, mirror)| mirror.lives) {
                let next = mirror.passes_on(space, &gid(space, teller, tag));
                waiting.extend(next.map(|next| (next, at as u128 + 1)));
            }
        }
        arrived
    }

    /// The spaces that announcements and messages can reach.
    fn reached(&self, from: usize) -> BTreeSet<usize> {
        let mut reached = BTreeSet::from([from]);
        loop {
            let links = self.mirrors.iter().filter(|mirror| mirror.lives);
            let ends = links.flat_map(|mirror| [(mirror.domain, mirror.far), (mirror.far, mirror.domain)]);
            let more: Vec<usize> = ends
                .filter(|(one, other)| reached.contains(one) && !reached.contains(other))
                .map(|(_, to)| to)
                .collect();
            if more.is_empty() {
                return reached;
            }
            reached.extend(more);
        }
    }

    fn check(&self) {
        for (home, space) in self.spaces.iter().enumerate() {
            for tag in space.natives.keys() {
                if !is_publisher(*tag) {
                    continue;
                }
                let (reached, arrivals) = (self.reached(home), self.arrivals(*tag));
                let listens = |at: &usize| self.spaces[*at].natives.keys().any(|tag| !is_publisher(*tag));
                let listening: BTreeSet<usize> =
                    reached.into_iter().filter(|at| *at != home && listens(at)).collect();
                for (at, count) in arrivals.iter().enumerate().filter(|(at, _)| *at != home) {
                    let most = usize::from(!listening.is_empty());
                    let least = usize::from(listening.contains(&at));
                    assert!(
                        (least..=most).contains(count),
                        "{tag} of {home}: {arrivals:?}, to {listening:?}"
                    );
                }
            }
        }
        let natives: BTreeSet<u64> =
            self.spaces.iter().flat_map(|space| space.natives.keys()).copied().collect();
        for told in self.spaces.iter().flat_map(|space| space.told.keys()) {
            assert!(natives.contains(&told.1), "a ghost");
        }
    }
}

impl Space {
    /// Replaces the announcements by `by`. Returns whether anything changed.
    fn say(&mut self, by: usize, told: BTreeMap<u64, Origin>) -> bool {
        let before = self.told.len();
        let mut changed = false;
        self.told.retain(|(teller, tag), _| *teller != by || told.contains_key(tag));
        changed |= self.told.len() != before;
        for (tag, origin) in told {
            changed |= self.told.insert((by, tag), origin.clone()).as_ref() != Some(&origin);
        }
        changed
    }
}

/// Domains first, then networks and ROS 2 graphs. `links`: domain, the other one, whether that is ROS.
fn run(spaces: usize, links: &[Link], seed: u64) {
    let mut random = SmallRng::seed_from_u64(seed);
    let mut world = World::new(spaces, links);
    for step in 0..12 {
        match random.random_range(0..4) {
            0 if step > 3 => {
                let at = random.random_range(0..links.len());
                match world.mirrors[at].lives {
                    true => world.kill(at),
                    false => {
                        let Mirror { domain, far, is_bridge, .. } = world.mirrors[at];
                        world.mirrors[at] = Mirror::new(domain, far, is_bridge);
                    }
                }
            }
            1 => {
                let space = random.random_range(0..spaces);
                world.spaces[space].natives.pop_first();
            }
            _ => drop(world.add(random.random_range(0..spaces))),
        }
        world.settle(&mut random);
        world.check();
    }
}

#[test]
fn a_message_comes_once_wherever_somebody_listens() {
    let seed = tautline_seed::seed();
    let arrangements: [(usize, &[Link]); 7] = [
        // ROS - A - network - B - ROS.
        (5, &[(0, 2, true), (0, 3, false), (1, 3, false), (1, 4, true)]),
        // Two bridges to one ROS, and a network between the same domains.
        (4, &[(0, 2, true), (1, 2, true), (0, 3, false), (1, 3, false)]),
        // Three hosts, one network, all with the same ROS.
        (5, &[(0, 3, false), (1, 3, false), (2, 3, false), (0, 4, true), (1, 4, true), (2, 4, true)]),
        // A host in two networks, which meet in a third one.
        (6, &[(0, 3, false), (0, 4, false), (1, 3, false), (2, 4, false), (1, 5, false), (2, 5, false)]),
        // A domain with two ROS graphs.
        (3, &[(0, 1, true), (0, 2, true)]),
        // A ring of ROS graphs alone.
        (6, &[(0, 3, true), (1, 3, true), (1, 4, true), (2, 4, true), (2, 5, true), (0, 5, true)]),
        // A chain of four domains.
        (7, &[(0, 4, false), (1, 4, false), (1, 5, true), (2, 5, true), (2, 6, false), (3, 6, false)]),
    ];
    for (at, (spaces, links)) in arrangements.into_iter().enumerate() {
        for round in 0..40 {
            run(spaces, links, seed ^ (at as u64) << 32 ^ round);
        }
    }
}

#[test]
fn any_arrangement_comes_to_rest() {
    let seed = tautline_seed::seed();
    for round in 0..150 {
        let mut random = SmallRng::seed_from_u64(seed ^ round);
        let (domains, others) = (random.random_range(1..5), random.random_range(1..4));
        let mut links = BTreeSet::new();
        for _ in 0..random.random_range(1..10) {
            let other = random.random_range(0..others);
            links.insert((random.random_range(0..domains), domains + other, other % 2 == 1));
        }
        let links: Vec<_> = links.into_iter().collect();
        run(domains + others, &links, seed ^ round);
    }
}

#[test]
fn what_does_not_go_on_stops_at_its_domain() {
    let transit = Transit::to_network(1, 2, 3, "host").going_on(false);
    let here = Origin { tag: 7, ..Origin::default() };
    let elsewhere = Origin { ros: 1, ..here.clone() };
    let announced = Origin { place: "host".into(), ..here.clone().told_by(1) };
    assert_eq!(transit.announced(&here), Some(announced));
    assert_eq!(transit.announced(&elsewhere), None);
    assert!(transit.origin_here(&elsewhere, 9).is_some() && transit.carries(&elsewhere, 9));
}

/// An announcement with another's tag and no path.
#[test]
fn nobody_tells_better_of_what_is_here() {
    let mut transit = Transit::to_network(1, 2, 3, "host");
    let here = Origin { tag: 7, ..Origin::default() };
    transit.insert(&Origin { place: "elsewhere".into(), ..here.clone() }, 0);
    assert!(transit.announced(&here).is_some());
}
