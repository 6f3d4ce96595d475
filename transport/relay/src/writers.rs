// SPDX-License-Identifier: MIT OR Apache-2.0
//! What stands on the far side for publishers here: whether it has found somebody.

use crate::mirror::TopicKey;
use std::collections::HashMap;
use std::time::{Duration, Instant};
use tautline_transport::Gid;

/// How long it is looked often whether a writer has found its subscriptions; afterwards, with each tick.
pub(crate) const MATCH_TIME: Duration = Duration::from_secs(3);

/// By the publisher here that each stands for.
pub struct Writers<W>(HashMap<(TopicKey, Gid), Held<W>>);

struct Held<W> {
    writer: W,
    opened: Instant,
    /// Whether samples go through it.
    is_open: bool,
    /// If they cannot: when that is tried again.
    later: Option<Instant>,
}

/// How long after a failure it is tried again.
const LATER: Duration = Duration::from_secs(1);

impl<W: FarWriter> Held<W> {
    fn is_due(&self, now: Instant) -> bool {
        !self.is_open && self.later.is_none_or(|later| now >= later)
    }
}

/// What stands for a publisher here.
pub trait FarWriter: Send {
    /// Whether it has somebody to send to: what is sent before is lost.
    fn is_matched(&self) -> bool;
}

impl<W> Default for Writers<W> {
    fn default() -> Self {
        Writers(HashMap::new())
    }
}

impl<W: FarWriter> Writers<W> {
    pub(crate) fn insert(&mut self, key: TopicKey, gid: Gid, writer: W) {
        self.0.insert((key, gid), Held { writer, opened: Instant::now(), is_open: false, later: None });
    }

    pub(crate) fn remove(&mut self, key: &TopicKey, gid: Gid) {
        self.0.remove(&(key.clone(), gid));
    }

    /// Those that are not as they should be.
    pub(crate) fn others(&self, is_right: impl Fn(&Gid, &W) -> bool) -> Vec<(TopicKey, Gid)> {
        let others = self.0.iter().filter(|((_, gid), held)| !is_right(gid, &held.writer));
        others.map(|(of, _)| of.clone()).collect()
    }

    /// All of them, each with the publisher that it stands for.
    pub fn iter(&self) -> impl Iterator<Item = (&TopicKey, Gid, &W)> {
        self.0.iter().map(|((key, gid), held)| (key, *gid, &held.writer))
    }

    /// As [`iter`](Self::iter).
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (&TopicKey, &mut W)> {
        self.0.iter_mut().map(|((key, _), held)| (key, &mut held.writer))
    }

    /// The topic's samples are not taken any more.
    pub(crate) fn close(&mut self, key: &TopicKey) {
        let of_topic = self.0.iter_mut().filter(|((topic, _), _)| topic == key);
        of_topic.for_each(|(_, held)| held.is_open = false);
    }

    /// Whether one of the topic's has somebody to send to.
    pub(crate) fn is_matched(&self, key: &TopicKey) -> bool {
        self.0.iter().any(|((topic, _), held)| topic == key && held.writer.is_matched())
    }

    /// Whether samples are to go through one soon, of topics that are taken.
    pub(crate) fn is_opening(&self, is_taken: impl Fn(&TopicKey) -> bool) -> bool {
        let now = Instant::now();
        self.0.iter().any(|((key, _), held)| held.is_due(now) && is_taken(key))
    }

    /// Opens those of topics that are taken once they have found somebody: what was sent before would be lost. One that finds
    /// nobody, while others do, does not keep its samples waiting for ever. `open` says whether that was possible, which it is tried
    /// again.
    pub(crate) fn open_matched(
        &mut self,
        is_taken: impl Fn(&TopicKey) -> bool,
        mut open: impl FnMut(&TopicKey, Gid, &W) -> bool,
    ) {
        let now = Instant::now();
        for ((key, gid), held) in &mut self.0 {
            let is_ready = || held.writer.is_matched() || now >= held.opened + MATCH_TIME;
            if held.is_due(now) && is_taken(key) && is_ready() {
                held.is_open = open(key, *gid, &held.writer);
                held.later = (!held.is_open).then_some(now + LATER);
            }
        }
    }
}
