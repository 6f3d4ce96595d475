// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which sample of which publisher comes next: counts what was overwritten, drops what comes twice.

use crate::doorbell::{LINKS, Link, NONE_FOR_IT};
use crate::header::Gid;
use crate::sync::Ordering;

/// Publishers remembered at once. More than a topic has; those that went are forgotten first.
const CAPACITY: usize = 128;

pub(crate) struct Tracker {
    seen: Vec<Seen>,
    /// Where the last publisher was found: most topics have one.
    last: usize,
    /// Publishers that have ended, until nothing of theirs can be in the queue.
    ended: Vec<Ended>,
}

struct Ended {
    gid: Gid,
    link: usize,
    start: u64,
    sent: u64,
}

struct Seen {
    gid: Gid,
    /// Sequence number expected next.
    next: u64,
    link: Option<usize>,
}

/// What a sample's sequence number says.
pub(crate) struct Noted {
    /// It came already, with the history, or is not for this subscription: it only makes room.
    pub(crate) duplicate: bool,
    /// Samples missing before this one.
    pub(crate) lost: u64,
    /// Samples of this publisher that waited, this one included; 0 if unknown.
    pub(crate) waiting: u64,
    /// The link of its publisher.
    pub(crate) link: Option<usize>,
}

impl Tracker {
    pub(crate) fn new() -> Self {
        let (seen, ended) = (Vec::with_capacity(CAPACITY), Vec::with_capacity(LINKS));
        Tracker { seen, last: 0, ended }
    }

    /// Notes a live sample. `None`: it came already, with the history.
    ///
    /// # Real-time
    /// O(1) for the publisher of the sample before, else O(publishers); no allocation; no syscall.
    pub(crate) fn note(&mut self, gid: Gid, sequence_number: u64, links: &[Link]) -> Option<Noted> {
        let index = match self.find(gid) {
            Some(index) => index,
            None => {
                // Matched before it sent this one: it wrote where its count starts for us. Earlier than that, the
                // sample reached us before the publisher knew of us, and nothing before it was meant for us.
                let start = links.iter().find(|link| link.gid() == gid).map_or(sequence_number, Link::start);
                let next = if start == NONE_FOR_IT { NONE_FOR_IT } else { start.min(sequence_number) };
                self.remember(gid, next, links)
            }
        };
        let seen = self.seen.get_mut(index)?;
        let link = seen
            .link
            .filter(|&link| links.get(link).is_some_and(|link| link.gid() == gid))
            .or_else(|| links.iter().position(|link| link.gid() == gid));
        let duplicate = sequence_number < seen.next;
        let lost = sequence_number.saturating_sub(seen.next);
        // Numbers are another process's claims: too large a one is a wrong count, not an overflow.
        seen.next = seen.next.max(sequence_number.saturating_add(1));
        seen.link = link;
        let mut waiting = 0;
        if let Some(link) = link.and_then(|link| links.get(link)) {
            waiting = link.out.sent.load(Ordering::Relaxed).saturating_add(1).saturating_sub(sequence_number);
            // Release: pairs with the Acquire in the publisher's check for room.
            link.taken.0.store(sequence_number, Ordering::Release);
        }
        Some(Noted { duplicate, lost, waiting, link })
    }

    /// Notes a sample of a history. False: it came already.
    pub(crate) fn note_history(&mut self, gid: Gid, sequence_number: u64, links: &[Link]) -> bool {
        let index = self.find(gid).unwrap_or_else(|| self.remember(gid, sequence_number, links));
        let Some(seen) = self.seen.get_mut(index).filter(|seen| sequence_number >= seen.next) else {
            return false;
        };
        seen.next = sequence_number.saturating_add(1);
        true
    }

    /// Notes which publishers have ended, before the queue is looked into: all that they sent is there by now.
    ///
    /// # Real-time
    /// O(links); no allocation; no syscall. Only when the topic's ports changed.
    pub(crate) fn note_ended(&mut self, links: &[Link]) {
        for (index, link) in links.iter().enumerate().filter(|(_, link)| link.has_ended()) {
            let gid = link.gid();
            if link.is_incomplete() {
                // It was killed while it claimed the link, and sent nothing that was counted here.
                link.settle(gid);
                continue;
            }
            if self.ended.len() < LINKS && !self.ended.iter().any(|ended| ended.gid == gid) {
                let (start, sent) = (link.start(), link.out.sent.load(Ordering::Relaxed));
                self.ended.push(Ended { gid, link: index, start, sent });
            }
        }
    }

    /// The queue is empty: what a publisher that had ended before it was looked into sent and never came, is lost.
    /// Returns how many.
    ///
    /// # Real-time
    /// Constant if no publisher has ended, else O(links); no allocation; no syscall.
    pub(crate) fn settle(&mut self, links: &[Link]) -> u64 {
        let mut lost = 0;
        while let Some(Ended { gid, link, start, sent }) = self.ended.pop() {
            let index = match self.find(gid) {
                Some(index) => index,
                None => self.remember(gid, start, links),
            };
            if let Some(seen) = self.seen.get_mut(index) {
                let next = sent.saturating_add(1);
                lost = next.saturating_sub(seen.next).saturating_add(lost);
                seen.next = seen.next.max(next);
            }
            if let Some(link) = links.get(link) {
                link.settle(gid);
            }
        }
        lost
    }

    fn find(&mut self, gid: Gid) -> Option<usize> {
        if self.seen.get(self.last).is_some_and(|seen| seen.gid == gid) {
            return Some(self.last);
        }
        let index = self.seen.iter().position(|seen| seen.gid == gid)?;
        self.last = index;
        Some(index)
    }

    fn remember(&mut self, gid: Gid, next: u64, links: &[Link]) -> usize {
        let seen = Seen { gid, next, link: None };
        if self.seen.len() < CAPACITY {
            self.seen.push(seen);
            return self.seen.len() - 1;
        }
        // Full: one that has gone makes room. There is one, since CAPACITY is more than a topic's publishers.
        let lives = |gid| links.iter().any(|link| link.gid() == gid && link.is_claimed());
        let index = self.seen.iter().position(|seen| !lives(seen.gid)).unwrap_or(0);
        self.seen[index] = seen;
        index
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::doorbell::{Arena, Owner};

    const A: Gid = Gid([1; 16]);
    const B: Gid = Gid([2; 16]);
    const C: Gid = Gid([3; 16]);

    #[test]
    fn gaps_are_counted_for_each_publisher() {
        let mut tracker = Tracker::new();
        let lost = |tracker: &mut Tracker, gid, n| {
            tracker.note(gid, n, &[]).filter(|noted| !noted.duplicate).map(|noted| noted.lost)
        };
        assert_eq!(lost(&mut tracker, A, 5), Some(0), "nothing is known of what came before");
        assert_eq!(lost(&mut tracker, B, 1), Some(0));
        assert_eq!(lost(&mut tracker, A, 9), Some(3));
        assert_eq!(lost(&mut tracker, B, 2), Some(0));
        assert_eq!(lost(&mut tracker, A, 9), None, "twice");
    }

    #[test]
    fn what_the_history_gave_is_not_given_again() {
        let mut tracker = Tracker::new();
        assert!(tracker.note_history(A, 3, &[]) && tracker.note_history(A, 4, &[]));
        assert!(!tracker.note_history(A, 3, &[]));
        assert!(tracker.note(A, 4, &[]).is_some_and(|noted| noted.duplicate));
        assert_eq!(tracker.note(A, 6, &[]).map(|noted| noted.lost), Some(1));
    }

    #[test]
    fn of_one_that_was_killed_while_it_claimed_its_link_nothing_is_lost() {
        let arena = Arena::create(117).unwrap();
        let claim = |gid, start| arena.claim_link(0, gid, start, (arena.id(), 7));
        let links = arena.links(0);
        let mut tracker = Tracker::new();
        assert_eq!(claim(A, 6), Some(0));
        links[0].out.sent.store(15, Ordering::Relaxed);
        links[0].release(Owner::of(A));
        tracker.note_ended(links);
        assert_eq!(tracker.settle(links), 10, "of A, nothing came");
        let killed = links[0].claim_and_die(B);
        tracker.note_ended(links);
        assert_eq!(tracker.settle(links), 0, "not known to be dead");
        links[0].release_killed(killed);
        tracker.note_ended(links);
        assert_eq!(tracker.settle(links), 0, "the numbers are A's");
        assert!(!links[0].has_ended(), "it is free");
        assert_eq!(claim(C, 1), Some(0));
    }

    #[test]
    fn any_number_is_a_count() {
        let mut tracker = Tracker::new();
        assert_eq!(tracker.note(A, u64::MAX, &[]).map(|noted| noted.lost), Some(0));
        assert_eq!(tracker.note(B, 1, &[]).map(|noted| noted.lost), Some(0));
        assert_eq!(tracker.note(B, u64::MAX, &[]).map(|noted| noted.lost), Some(u64::MAX - 2));
        assert!(!tracker.note_history(B, 7, &[]));
        let counters = super::super::Counters::default();
        super::super::hot::add(&counters.lost, u64::MAX - 2);
        super::super::hot::add(&counters.lost, u64::MAX);
        assert_eq!(counters.lost(), u64::MAX);
    }

    #[test]
    fn more_publishers_than_it_remembers() {
        let mut tracker = Tracker::new();
        for n in 0..=CAPACITY as u128 {
            assert!(tracker.note(Gid(n.to_le_bytes()), 7, &[]).is_some());
        }
        assert_eq!(tracker.note(Gid(1u128.to_le_bytes()), 8, &[]).map(|noted| noted.lost), Some(0));
    }
}
