// SPDX-License-Identifier: MIT OR Apache-2.0
//! What one publisher and one subscription tell each other, and who may write it: claimed, ended, settled, claimed again.

use super::arena::ArenaId;
use crate::header::Gid;
use crate::sync::{AtomicU32, AtomicU64, Ordering};
use tautline_rt::clock::monotonic_ns;

/// Publishers that one subscription can tell apart: the most publishers of a topic.
pub(crate) const LINKS: usize = 64;
/// Owner word of a link nobody uses.
const FREE: u64 = 0;
/// Owner word of a link whose publisher has ended; its numbers stay until the subscription has settled them.
const ENDED: u64 = 1;

/// One publisher seen from one subscription. Two cache lines, one for each writer.
#[repr(C)]
pub(crate) struct Link {
    pub(crate) out: LinkOut,
    pub(crate) taken: Taken,
}

/// Written by the publisher.
#[repr(C, align(64))]
pub(crate) struct LinkOut {
    owner: AtomicU64,
    gid: [AtomicU64; 2],
    start: AtomicU64,
    pub(crate) sent: AtomicU64,
    waiter_arena: AtomicU64,
    waiter_slot: AtomicU32,
    pub(crate) waiting: AtomicU32,
    /// When it last showed that it is alive; [`KILLED`] once it was found dead.
    pub(crate) alive_ns: AtomicU64,
}

/// Where the count of a publisher starts whose samples are not for the subscription: one that does not fit it.
pub(crate) const NONE_FOR_IT: u64 = u64::MAX;

/// What `alive_ns` says of a publisher that ended without a word.
pub(crate) const KILLED: u64 = 0;

/// Written by the subscription: the sequence number it took last.
#[repr(C, align(64))]
pub(crate) struct Taken(pub(crate) AtomicU64);

impl Link {
    /// Claims one of a subscription's links for a publisher; `None` if all are taken.
    pub(crate) fn claim_one_of(
        links: &[Link],
        gid: Gid,
        start: u64,
        waiter: (ArenaId, usize),
    ) -> Option<usize> {
        let claim = |from| links.iter().position(|link| link.claim(from, gid, start, waiter));
        // Of a subscription that never takes, links of ended publishers are never settled: better uncounted than none.
        claim(FREE).or_else(|| claim(ENDED))
    }

    /// Makes it look never used.
    pub(crate) fn reset(&self) {
        if self.out.owner.load(Ordering::Relaxed) != FREE {
            self.out.gid[0].store(0, Ordering::Relaxed);
            self.out.gid[1].store(0, Ordering::Relaxed);
            self.out.owner.store(FREE, Ordering::Release);
        }
    }

    /// Claims the link, if its owner word is `from`, for a publisher whose next sample will be number `start`, or
    /// [`NONE_FOR_IT`].
    fn claim(&self, from: u64, gid: Gid, start: u64, waiter: (ArenaId, usize)) -> bool {
        if !self.begin_claim(from, Owner::of(gid)) {
            return false;
        }
        let [low, high] = gid.words();
        self.out.start.store(start, Ordering::Relaxed);
        self.out.sent.store(start.saturating_sub(1), Ordering::Relaxed);
        self.taken.0.store(start.saturating_sub(1), Ordering::Relaxed);
        self.out.waiting.store(0, Ordering::Relaxed);
        self.out.alive_ns.store(monotonic_ns(), Ordering::Relaxed);
        self.out.waiter_arena.store(waiter.0.0, Ordering::Relaxed);
        self.out.waiter_slot.store(waiter.1 as u32, Ordering::Relaxed);
        self.out.gid[0].store(low, Ordering::Relaxed);
        // Release: pairs with the Acquire in `gid`; who reads this gid reads this claim's start.
        self.out.gid[1].store(high, Ordering::Release);
        true
    }

    /// The first step: nobody's until the claim is complete. Should this process be killed within, the numbers are no publisher's:
    /// see [`is_incomplete`](Self::is_incomplete).
    fn begin_claim(&self, from: u64, owner: Owner) -> bool {
        if self.out.owner.compare_exchange(from, owner.0, Ordering::AcqRel, Ordering::Relaxed).is_err() {
            return false;
        }
        self.out.gid[1].store(0, Ordering::Relaxed);
        self.out.gid[0].store(0, Ordering::Release);
        true
    }

    pub(crate) fn gid(&self) -> Gid {
        let high = self.out.gid[1].load(Ordering::Acquire);
        Gid::from_words([self.out.gid[0].load(Ordering::Relaxed), high])
    }

    pub(crate) fn start(&self) -> u64 {
        self.out.start.load(Ordering::Relaxed)
    }

    pub(crate) fn waiter(&self) -> (ArenaId, usize) {
        let arena = ArenaId(self.out.waiter_arena.load(Ordering::Relaxed));
        (arena, self.out.waiter_slot.load(Ordering::Relaxed) as usize)
    }

    /// The publisher `owner` ends, or was killed. Its numbers stay, so that samples still queued are counted rightly. Does nothing if the
    /// link is another's by now: a publisher may learn late that a subscription went, and its slot was claimed again.
    pub(crate) fn release(&self, owner: Owner) {
        let _ = self.out.owner.compare_exchange(owner.0, ENDED, Ordering::Release, Ordering::Relaxed);
    }

    /// The publisher `owner` was killed.
    pub(crate) fn release_killed(&self, owner: Owner) {
        if self.owner() == Some(owner) {
            self.out.alive_ns.store(KILLED, Ordering::Relaxed);
            self.release(owner);
        }
    }

    /// Whose the link is, if a publisher claimed it. Not its gid: that comes after the claim, and perhaps never.
    pub(crate) fn owner(&self) -> Option<Owner> {
        let owner = self.out.owner.load(Ordering::Acquire);
        (owner > ENDED).then_some(Owner(owner))
    }

    pub(crate) fn is_claimed(&self) -> bool {
        self.out.owner.load(Ordering::Acquire) > ENDED
    }

    /// Whether the publisher has ended and the subscription has not settled what it sent.
    pub(crate) fn has_ended(&self) -> bool {
        // Acquire: pairs with the Release in `release`; the publisher's last numbers are seen.
        self.out.owner.load(Ordering::Acquire) == ENDED
    }

    /// Whether a claim was begun and its end is not seen: one of the gid's words is 0, as no publisher's is. If the link has ended
    /// by now, the claimer was killed, and what else stands here is of the publisher before it.
    pub(crate) fn is_incomplete(&self) -> bool {
        self.gid().words().contains(&0)
    }

    /// The subscription has settled what the ended publisher `gid` sent.
    pub(crate) fn settle(&self, gid: Gid) {
        if self.gid() == gid {
            let _ = self.out.owner.compare_exchange(ENDED, FREE, Ordering::AcqRel, Ordering::Relaxed);
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
impl Link {
    /// A publisher that is killed while it claims the link.
    pub(crate) fn claim_and_die(&self, gid: Gid) -> Owner {
        let owner = Owner::of(gid);
        assert!(self.begin_claim(FREE, owner));
        owner
    }
}

/// Who claimed a link: a word made of all of a publisher's gid. Those of gids that have one half in common differ; else two are the
/// same by a chance of 1 in 2^64.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Owner(u64);

impl Owner {
    pub(crate) fn of(gid: Gid) -> Self {
        let [low, high] = gid.words();
        match mixed(mixed(low) ^ high) {
            reserved @ (FREE | ENDED) => Owner(!reserved),
            owner => Owner(owner),
        }
    }
}

/// One to one, and each bit depends on all: the last steps of SplitMix64 (Steele, Lea, Flood, 2014).
const fn mixed(word: u64) -> u64 {
    let word = (word ^ word >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let word = (word ^ word >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    word ^ word >> 31
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::doorbell::arena::Arena;

    const DOMAIN: u32 = 116;

    #[test]
    fn a_link_is_released_by_its_owner_alone() {
        let arena = Arena::create(DOMAIN).unwrap();
        let (old, new, third) = (Gid([4; 16]), Gid([8; 16]), Gid([12; 16]));
        assert_eq!(arena.claim_link(0, old, 1, (arena.id(), 7)), Some(0));
        // The subscription behind the slot goes, another comes, and a publisher matches it before `old` has noticed.
        arena.links(0).iter().for_each(Link::reset);
        assert_eq!(arena.claim_link(0, new, 5, (arena.id(), 8)), Some(0));
        let link = &arena.links(0)[0];
        link.release(Owner::of(old));
        assert!(link.is_claimed());
        assert_eq!(arena.claim_link(0, third, 1, (arena.id(), 9)), Some(1));
        link.release(Owner::of(new));
        assert!(!link.is_claimed());
        assert_eq!((link.gid(), link.start()), (new, 5), "readable until it is claimed again");
    }

    #[test]
    fn owners_whose_gids_share_a_half_differ() {
        let of = |low: u64, high: u64| Owner::of(Gid::from_words([low, high]));
        // Seconds and nanoseconds below, process and counter above, as iceoryx2 numbers its ports.
        let (time, process) = (17_u64 | 123_456_789 << 32, 4242_u64 | 5 << 32);
        for bit in 0..64 {
            assert_ne!(of(time, process), of(time ^ 1 << bit, process), "bit {bit} of the low half");
            assert_ne!(of(time, process), of(time, process ^ 1 << bit), "bit {bit} of the high half");
        }
        let owners: Vec<_> =
            (0..100).flat_map(|n| [of(time, process + (n << 32)), of(time + n + 1, process)]).collect();
        let is_twice = |(index, owner): (usize, &Owner)| owners[..index].contains(owner);
        assert!(!owners.iter().enumerate().any(is_twice));
        assert!(of(0, 0).0 > ENDED, "what mixes to a reserved value is moved away from it");
    }

    #[test]
    fn a_publisher_of_the_same_instant_does_not_release_anothers_link() {
        let arena = Arena::create(DOMAIN).unwrap();
        let gid = |counter: u64| Gid::from_words([7, 4242 | counter << 32]);
        let (old, new) = (gid(1), gid(2));
        assert_eq!(arena.claim_link(0, old, 1, (arena.id(), 7)), Some(0));
        arena.links(0).iter().for_each(Link::reset);
        assert_eq!(arena.claim_link(0, new, 5, (arena.id(), 8)), Some(0));
        let link = &arena.links(0)[0];
        link.release(Owner::of(old));
        link.release_killed(Owner::of(old));
        assert!(link.is_claimed() && link.owner() == Some(Owner::of(new)));
    }

    #[test]
    fn all_links_taken() {
        let arena = Arena::create(DOMAIN).unwrap();
        for n in 0..LINKS {
            assert_eq!(arena.claim_link(3, Gid([4 * n as u8; 16]), 1, (arena.id(), 0)), Some(n));
        }
        assert_eq!(arena.claim_link(3, Gid([255; 16]), 1, (arena.id(), 0)), None);
    }
}
