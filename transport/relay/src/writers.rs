// SPDX-License-Identifier: MIT OR Apache-2.0
//! The writers that mirror publishers on the far side, and whether they have matched.

use crate::mirror::TopicKey;
use std::collections::{BTreeSet, HashMap};
use std::time::{Duration, Instant};
use tautline_transport::Gid;

/// How long a new writer is polled at short intervals for matches; later, it is polled at each tick.
pub(crate) const MATCH_TIME: Duration = Duration::from_secs(3);

/// How long the writer of an ended publisher is kept until all of its samples have arrived: two heartbeats of Fast DDS, of 3 s each,
/// after which samples that did not fit are sent again.
pub(crate) const SETTLE_TIME: Duration = Duration::from_secs(7);

/// Writers by topic and mirrored publisher.
pub struct Writers<W> {
    held: HashMap<(TopicKey, Gid), OpenedWriter<W>>,
    /// Time of the next check for writers to open.
    next: Option<Instant>,
    /// Writers of ended publishers, with the time of their end, until all of their samples have arrived.
    ended: Vec<(TopicKey, W, Instant)>,
}

struct OpenedWriter<W> {
    writer: W,
    opened: Instant,
    /// Whether samples are sent through it.
    is_open: bool,
    /// The time of the next attempt, after opening failed.
    later: Option<Instant>,
}

/// Delay of a retry.
const LATER: Duration = Duration::from_secs(1);

/// Mirrors a publisher of the domain.
pub trait FarWriter: Send {
    /// Whether the writer has matched: samples that are sent before are lost.
    fn is_matched(&self) -> bool;

    /// Whether all samples of the writer have arrived: if it is dropped before, the others are lost.
    fn is_settled(&self) -> bool {
        true
    }
}

impl<W> Default for Writers<W> {
    fn default() -> Self {
        Writers { held: HashMap::new(), next: None, ended: Vec::new() }
    }
}

impl<W: FarWriter> Writers<W> {
    pub(crate) fn insert(&mut self, key: TopicKey, gid: Gid, writer: W) {
        self.request_check();
        self.held
            .insert((key, gid), OpenedWriter { writer, opened: Instant::now(), is_open: false, later: None });
    }

    /// Removes a writer, which is dropped as soon as all of its samples have arrived: see [`drop_settled`](Self::drop_settled).
    pub(crate) fn remove(&mut self, key: &TopicKey, gid: Gid) {
        let removed = self.held.remove_entry(&(key.clone(), gid));
        self.ended.extend(removed.map(|((key, _), held)| (key, held.writer, Instant::now())));
    }

    /// Removes all writers, like [`remove`](Self::remove).
    pub(crate) fn remove_all(&mut self) {
        let now = Instant::now();
        self.ended.extend(self.held.drain().map(|((key, _), held)| (key, held.writer, now)));
    }

    /// Drops removed writers that have settled, or that were removed at least `patience` ago. Returns whether others are left.
    pub(crate) fn drop_settled(&mut self, patience: Duration) -> bool {
        let mut late = BTreeSet::new();
        self.ended.retain(|(key, writer, since)| {
            let (is_settled, is_late) = (writer.is_settled(), since.elapsed() >= patience);
            if is_late && !is_settled {
                late.insert(key.topic.clone());
            }
            !is_settled && !is_late
        });
        for topic in late {
            tracing::warn!(
                "topic '{topic}': a publisher has ended, and its last messages were not confirmed within {patience:?}: they may be lost on the \
                 far side"
            );
        }
        !self.ended.is_empty()
    }

    /// The writers for which `is_right` is false.
    pub(crate) fn outdated(&self, is_right: impl Fn(&Gid, &W) -> bool) -> Vec<(TopicKey, Gid)> {
        let others = self.held.iter().filter(|((_, gid), held)| !is_right(gid, &held.writer));
        others.map(|(of, _)| of.clone()).collect()
    }

    /// All writers, each with its topic and publisher.
    pub fn iter(&self) -> impl Iterator<Item = (&TopicKey, Gid, &W)> {
        self.held.iter().map(|((key, gid), held)| (key, *gid, &held.writer))
    }

    /// All writers, each with its topic.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (&TopicKey, &mut W)> {
        self.held.iter_mut().map(|((key, _), held)| (key, &mut held.writer))
    }

    /// Closes the writers of a topic whose samples are no longer taken.
    pub(crate) fn close(&mut self, key: &TopicKey) {
        let of_topic = self.held.iter_mut().filter(|((topic, _), _)| topic == key);
        of_topic.for_each(|(_, held)| held.is_open = false);
    }

    /// Whether one of the topic's writers has matched.
    pub(crate) fn is_matched(&self, key: &TopicKey) -> bool {
        self.held.iter().any(|((topic, _), held)| topic == key && held.writer.is_matched())
    }

    /// Requests a check for writers to open, because there is a new writer, or a topic's samples are taken from now on.
    pub(crate) fn request_check(&mut self) {
        self.next = Some(Instant::now());
    }

    /// The removed writers that have not settled yet.
    pub fn settling(&self) -> impl Iterator<Item = &W> {
        self.ended.iter().map(|(_, writer, _)| writer).filter(|writer| !writer.is_settled())
    }

    /// Whether removed writers have not settled yet.
    pub(crate) fn is_settling(&self) -> bool {
        !self.ended.is_empty()
    }

    /// Whether a check for writers to open is due.
    pub(crate) fn is_opening(&self) -> bool {
        self.next.is_some_and(|next| Instant::now() >= next)
    }

    /// Opens matched writers of topics for which `is_meant` is true: samples sent before a match would be lost. A writer without a match
    /// opens after `MATCH_TIME`, so that its samples are not held forever. `make` creates the sender; if that fails, it is retried
    /// later.
    pub(crate) fn open<S>(
        &mut self,
        is_meant: impl Fn(&TopicKey) -> bool,
        mut make: impl FnMut(&TopicKey, &W) -> Option<S>,
    ) -> Vec<(TopicKey, Gid, S)> {
        let (now, mut opened) = (Instant::now(), Vec::new());
        let closed = self.held.iter_mut().filter(|((key, _), held)| !held.is_open && is_meant(key));
        for ((key, gid), held) in closed.filter(|(_, held)| held.later.is_none_or(|later| now >= later)) {
            if held.writer.is_matched() || now >= held.opened + MATCH_TIME {
                let sender = make(key, &held.writer);
                held.is_open = sender.is_some();
                held.later = sender.is_none().then_some(now + LATER);
                opened.extend(sender.map(|sender| (key.clone(), *gid, sender)));
            }
        }
        opened
    }

    /// Sets the time of the next check, by the closed writers of topics whose samples are taken.
    pub(crate) fn schedule_check(&mut self, is_taken: impl Fn(&TopicKey) -> bool) {
        let closed = self.held.iter().filter(|((key, _), held)| !held.is_open && is_taken(key));
        self.next = closed.map(|(_, held)| held.later.unwrap_or_else(Instant::now)).min();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    /// Has settled once this is set.
    struct Settles(Arc<AtomicBool>);

    impl FarWriter for Settles {
        fn is_matched(&self) -> bool {
            true
        }

        fn is_settled(&self) -> bool {
            self.0.load(Ordering::Relaxed)
        }
    }

    #[test]
    fn an_ended_publishers_writer_stays_until_all_has_arrived() {
        let key = TopicKey {
            topic: "/x".to_owned(),
            far_topic: "/x".to_owned(),
            type_name: "std_msgs/msg/String".to_owned(),
            type_hash: None,
        };
        let settled = [false, true].map(|is_settled| Arc::new(AtomicBool::new(is_settled)));
        let mut writers = Writers::default();
        for (gid, settled) in [1, 2].map(|id| Gid([id; 16])).into_iter().zip(&settled) {
            writers.insert(key.clone(), gid, Settles(settled.clone()));
        }
        writers.remove(&key, Gid([1; 16]));
        writers.remove_all();
        assert_eq!((writers.iter().count(), writers.is_settling()), (0, true));
        let held = || settled.each_ref().map(|settled| Arc::strong_count(settled) - 1);
        assert_eq!((writers.drop_settled(SETTLE_TIME), held()), (true, [1, 0]));
        settled[0].store(true, Ordering::Relaxed);
        assert_eq!((writers.drop_settled(SETTLE_TIME), held()), (false, [0, 0]));
        // What never settles does not stay for ever.
        settled[0].store(false, Ordering::Relaxed);
        writers.insert(key.clone(), Gid([1; 16]), Settles(settled[0].clone()));
        writers.remove_all();
        writers.ended[0].2 -= SETTLE_TIME;
        assert_eq!((writers.drop_settled(SETTLE_TIME), held()), (false, [0, 0]));
    }
}
