// SPDX-License-Identifier: MIT OR Apache-2.0
//! The order of what transient-local publishers keep and what they publish: a publisher's kept samples are requested when it appears,
//! and its new samples wait for them.
//!
//! zenoh-ext's `AdvancedSubscriber` has no such order: a new sample that arrives during the request is delivered at once, and the kept
//! ones are then dropped as older (1.10.2). The gateway uses it to recover lost samples only.

use std::collections::HashMap;
use std::str::FromStr;
use zenoh::sample::Sample;
use zenoh::session::ZenohId;

/// A publisher, as zenoh-ext tells it apart: its session, and its number there. `None`: all of the session whose samples have only
/// a time stamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Publisher([u8; 16], Option<u32>);

impl Publisher {
    /// From the key of the token `<topic>/@adv/pub/<session>/<number or uhlc>/<metadata>` of a publisher that is not of the session
    /// `own`.
    pub(crate) fn of_token(key: &str, own: ZenohId) -> Option<Self> {
        let (_, publisher) = key.rsplit_once("/@adv/pub/")?;
        let mut parts = publisher.split('/');
        let session = ZenohId::from_str(parts.next()?).ok().filter(|session| *session != own)?;
        let number = match parts.next()? {
            "uhlc" => None,
            number => Some(number.parse().ok()?),
        };
        Some(Publisher(session.to_le_bytes(), number))
    }

    /// Whether it is one publisher.
    pub(crate) fn is_single(&self) -> bool {
        self.1.is_some()
    }
}

/// What has a place among the samples of its publisher.
pub(crate) trait Placed {
    /// The publisher, and a number that grows with each of its samples; modulo 2^32 if the publisher has a number. `None`: it has neither.
    fn place(&self) -> Option<(Publisher, u64)>;
}

impl Placed for Sample {
    fn place(&self) -> Option<(Publisher, u64)> {
        match (self.source_info(), self.timestamp()) {
            (Some(info), _) => {
                let id = info.source_id();
                Some((Publisher(id.zid().to_le_bytes(), Some(id.eid())), info.source_sn().into()))
            }
            (None, Some(time)) => {
                Some((Publisher(time.get_id().to_le_bytes(), None), time.get_time().as_u64()))
            }
            (None, None) => None,
        }
    }
}

/// How far `number` is after `base`; negative: before it.
fn after(publisher: Publisher, number: u64, base: u64) -> i64 {
    match publisher.is_single() {
        true => i64::from((number as u32).wrapping_sub(base as u32) as i32),
        false => number.wrapping_sub(base) as i64,
    }
}

/// The state of a topic's publishers.
pub(crate) struct Kept<S> {
    /// As many kept samples are requested of each publisher.
    depth: usize,
    publishers: HashMap<Publisher, State<S>>,
}

struct State<S> {
    /// Requests without an answer.
    requests: usize,
    /// New samples that wait for the answer; at most `depth`, because more of them replace all that is kept.
    waiting: Vec<S>,
    /// Whether they no longer wait.
    is_full: bool,
    /// The numbers of the first and of the last delivered sample.
    delivered: Option<(u64, u64)>,
}

impl<S: Placed> Kept<S> {
    /// Maximum of publishers; beyond it, which a hostile peer can cause, no more is requested and samples are not ordered.
    const MOST: usize = 1024;

    pub(crate) fn new(depth: usize) -> Self {
        Kept { depth, publishers: HashMap::new() }
    }

    /// A publisher has appeared. Returns whether to request what it keeps; [`answered`](Self::answered) must follow.
    pub(crate) fn appeared(&mut self, publisher: Publisher) -> bool {
        let state = self.state(publisher);
        state.map(|state| state.requests += 1).is_some()
    }

    /// A new sample: gives to `deliver` what is due now, in order.
    ///
    /// # Real-time
    /// One look-up. A sample that waits is stored on the heap.
    pub(crate) fn published(&mut self, sample: S, deliver: &mut impl FnMut(S)) {
        let depth = self.depth;
        let Some((publisher, number)) = sample.place() else { return deliver(sample) };
        let Some(state) = self.state(publisher) else { return deliver(sample) };
        if state.requests == 0 || state.is_full {
            return state.deliver(publisher, number, sample, deliver);
        }
        let last = state.waiting.last().and_then(S::place).map(|(_, last)| last);
        let last = last.or(state.delivered.map(|(_, last)| last));
        if last.is_none_or(|last| after(publisher, number, last) > 0) {
            state.waiting.push(sample);
            state.is_full = state.waiting.len() >= depth;
        }
        if state.is_full {
            state.release(publisher, deliver);
        }
    }

    /// The answer to a request: gives to `deliver` the kept samples and what waited for them. Returns how many kept samples came too
    /// late, after newer ones.
    pub(crate) fn answered(
        &mut self,
        publisher: Publisher,
        mut kept: Vec<S>,
        deliver: &mut impl FnMut(S),
    ) -> u64 {
        let Some(state) = self.publishers.get_mut(&publisher) else { return 0 };
        let number = |sample: &S| sample.place().filter(|(of, _)| *of == publisher).map(|(_, number)| number);
        // Caches of one session answer one after the other.
        if let Some(base) = kept.iter().find_map(number) {
            kept.sort_by_key(|sample| number(sample).map(|number| after(publisher, number, base)));
        }
        let first = state.delivered.filter(|_| !state.is_full).map(|(first, _)| first);
        let mut late = 0;
        for sample in kept {
            // Another publisher's has no place here.
            let Some(number) = number(&sample) else { continue };
            late += u64::from(first.is_some_and(|first| after(publisher, number, first) < 0));
            state.deliver(publisher, number, sample, deliver);
        }
        state.requests -= 1;
        if state.requests == 0 {
            state.release(publisher, deliver);
            state.is_full = false;
        }
        late
    }

    fn state(&mut self, publisher: Publisher) -> Option<&mut State<S>> {
        if self.publishers.len() >= Self::MOST && !self.publishers.contains_key(&publisher) {
            self.publishers.retain(|_, state| state.requests > 0);
            if self.publishers.len() >= Self::MOST {
                return None;
            }
        }
        let (requests, waiting, is_full, delivered) = Default::default();
        Some(self.publishers.entry(publisher).or_insert(State { requests, waiting, is_full, delivered }))
    }
}

impl<S: Placed> State<S> {
    /// Delivers a sample, unless it or a newer one was delivered before.
    fn deliver(&mut self, publisher: Publisher, number: u64, sample: S, deliver: &mut impl FnMut(S)) {
        match &mut self.delivered {
            None => self.delivered = Some((number, number)),
            Some((_, last)) if after(publisher, number, *last) > 0 => *last = number,
            Some(_) => return,
        }
        deliver(sample);
    }

    fn release(&mut self, publisher: Publisher, deliver: &mut impl FnMut(S)) {
        for sample in std::mem::take(&mut self.waiting) {
            if let Some((_, number)) = sample.place() {
                self.deliver(publisher, number, sample, deliver);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONE: Publisher = Publisher([1; 16], Some(7));
    const OTHER: Publisher = Publisher([1; 16], Some(8));
    const BY_TIME: Publisher = Publisher([1; 16], None);

    type Test = Option<(Publisher, u64)>;

    impl Placed for Test {
        fn place(&self) -> Option<(Publisher, u64)> {
            *self
        }
    }

    fn published(kept: &mut Kept<Test>, publisher: Publisher, numbers: &[u64]) -> Vec<u64> {
        let mut delivered = Vec::new();
        for &number in numbers {
            kept.published(Some((publisher, number)), &mut |sample| delivered.push(sample.unwrap().1));
        }
        delivered
    }

    fn answered(kept: &mut Kept<Test>, publisher: Publisher, numbers: &[u64]) -> (Vec<u64>, u64) {
        let mut delivered = Vec::new();
        let answer = numbers.iter().map(|&number| Some((publisher, number))).collect();
        let late = kept.answered(publisher, answer, &mut |sample| delivered.push(sample.unwrap().1));
        (delivered, late)
    }

    #[test]
    fn what_is_new_waits_for_what_was_kept() {
        let mut kept = Kept::new(3);
        assert!(kept.appeared(ONE));
        assert!(published(&mut kept, ONE, &[2, 3]).is_empty());
        assert_eq!(published(&mut kept, OTHER, &[5]), [5], "of another publisher");
        assert_eq!(answered(&mut kept, ONE, &[1, 2, 3]), (vec![1, 2, 3], 0));
        assert_eq!(published(&mut kept, ONE, &[3, 4, 4, 6]), [4, 6]);
        let mut without = 0;
        kept.published(None, &mut |_| without += 1);
        assert_eq!(without, 1, "without a number");
        // Its host was away: what it kept since then comes, and nothing twice.
        assert!(kept.appeared(ONE));
        assert!(published(&mut kept, ONE, &[5, 6, 9]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[6, 7, 8]), (vec![7, 8, 9], 0));
    }

    #[test]
    fn no_answer_and_two() {
        let mut kept = Kept::new(3);
        assert!(kept.appeared(ONE) && kept.appeared(ONE));
        assert!(published(&mut kept, ONE, &[5]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[]), (vec![], 0));
        assert_eq!(answered(&mut kept, ONE, &[4]), (vec![4, 5], 0));
        assert_eq!(published(&mut kept, ONE, &[6]), [6]);
    }

    #[test]
    fn as_many_new_samples_as_are_kept_do_not_wait() {
        let mut kept = Kept::new(3);
        assert!(kept.appeared(ONE));
        assert!(published(&mut kept, ONE, &[11, 11, 12]).is_empty());
        assert_eq!(published(&mut kept, ONE, &[13, 14]), [11, 12, 13, 14]);
        assert_eq!(answered(&mut kept, ONE, &[9, 10, 11]), (vec![], 0), "they have replaced these");
        assert!(kept.appeared(ONE));
        assert!(published(&mut kept, ONE, &[15]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[14, 15, 16]), (vec![15, 16], 0));
    }

    #[test]
    fn kept_samples_after_newer_ones_are_counted() {
        let mut kept = Kept::new(3);
        assert_eq!(published(&mut kept, ONE, &[3]), [3]);
        assert!(kept.appeared(ONE));
        assert_eq!(answered(&mut kept, ONE, &[1, 2, 3, 4]), (vec![4], 2));
    }

    #[test]
    fn numbers_wrap_and_times_are_sorted() {
        let mut kept = Kept::new(4);
        let last = u64::from(u32::MAX);
        assert!(kept.appeared(ONE) && kept.appeared(BY_TIME));
        assert!(published(&mut kept, ONE, &[0, 1]).is_empty());
        assert_eq!(answered(&mut kept, ONE, &[last - 1, last, 0]), (vec![last - 1, last, 0, 1], 0));
        // Of two publishers of a session.
        let times = [1 << 40, 3 << 40, 2 << 40, 4 << 40];
        assert_eq!(answered(&mut kept, BY_TIME, &times), (vec![1 << 40, 2 << 40, 3 << 40, 4 << 40], 0));
        // Any numbers, from a hostile peer.
        assert!(kept.appeared(OTHER));
        answered(&mut kept, OTHER, &[0, 1 << 31, 1, u64::MAX, 3 << 30, 1 << 30]);
    }

    #[test]
    fn there_is_a_most() {
        let mut kept = Kept::<Test>::new(1);
        let publisher = |n: usize| Publisher([2; 16], Some(n as u32));
        assert!((0..Kept::<Test>::MOST).all(|n| kept.appeared(publisher(n))));
        assert!(!kept.appeared(ONE));
        assert_eq!(published(&mut kept, ONE, &[2, 1]), [2, 1]);
        answered(&mut kept, publisher(0), &[]);
        assert!(kept.appeared(ONE));
    }

    #[test]
    fn tokens_of_publishers() {
        let own = ZenohId::from_str("aa").unwrap();
        let of = |key: &str| Publisher::of_token(key, own);
        let mut session = [0; 16];
        session[0] = 0xbb;
        assert_eq!(of("0/map/T/H/@adv/pub/bb/12/_"), Some(Publisher(session, Some(12))));
        assert_eq!(of("0/map/T/H/@adv/pub/bb/uhlc/_"), Some(Publisher(session, None)));
        for key in
            ["", "0/map/T/H", "m/@adv/pub/aa/12/_", "m/@adv/pub/bb", "m/@adv/pub/zz/1/_", "m/@adv/pub/bb/x/_"]
        {
            assert_eq!(of(key), None, "{key}");
        }
    }
}
