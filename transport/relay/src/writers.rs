// SPDX-License-Identifier: MIT OR Apache-2.0
//! What stands on the far side for publishers here: whether it has found somebody.

use crate::mirror::TopicKey;
use std::collections::HashMap;
use std::time::{Duration, Instant};
use tautline_transport::Gid;

/// How long it is looked often whether a writer has found its subscriptions; afterwards, with each tick.
pub(crate) const MATCH_TIME: Duration = Duration::from_secs(3);

/// By the publisher here that each stands for.
pub struct Writers<W> {
    held: HashMap<(TopicKey, Gid), Held<W>>,
    /// When it is to be looked whether some can be opened.
    next: Option<Instant>,
}

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

type Open<'o, W> = &'o mut dyn FnMut(&TopicKey, Gid, &W) -> bool;

impl<W: FarWriter> Held<W> {
    /// Once it has found somebody: what was sent before would be lost. One that finds nobody, while others of its topic do, does not keep
    /// its samples waiting for ever.
    fn open(&mut self, key: &TopicKey, gid: Gid, now: Instant, open: Open<'_, W>) {
        let is_due = !self.is_open && self.later.is_none_or(|later| now >= later);
        if is_due && (self.writer.is_matched() || now >= self.opened + MATCH_TIME) {
            self.is_open = open(key, gid, &self.writer);
            self.later = (!self.is_open).then_some(now + LATER);
        }
    }
}

/// What stands for a publisher here.
pub trait FarWriter: Send {
    /// Whether it has somebody to send to: what is sent before is lost.
    fn is_matched(&self) -> bool;
}

impl<W> Default for Writers<W> {
    fn default() -> Self {
        Writers { held: HashMap::new(), next: None }
    }
}

impl<W: FarWriter> Writers<W> {
    pub(crate) fn insert(&mut self, key: TopicKey, gid: Gid, writer: W) {
        self.take();
        self.held.insert((key, gid), Held { writer, opened: Instant::now(), is_open: false, later: None });
    }

    pub(crate) fn remove(&mut self, key: &TopicKey, gid: Gid) {
        self.held.remove(&(key.clone(), gid));
    }

    /// Those that are not as they should be.
    pub(crate) fn others(&self, is_right: impl Fn(&Gid, &W) -> bool) -> Vec<(TopicKey, Gid)> {
        let others = self.held.iter().filter(|((_, gid), held)| !is_right(gid, &held.writer));
        others.map(|(of, _)| of.clone()).collect()
    }

    /// All of them, each with the publisher that it stands for.
    pub fn iter(&self) -> impl Iterator<Item = (&TopicKey, Gid, &W)> {
        self.held.iter().map(|((key, gid), held)| (key, *gid, &held.writer))
    }

    /// As [`iter`](Self::iter).
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (&TopicKey, &mut W)> {
        self.held.iter_mut().map(|((key, _), held)| (key, &mut held.writer))
    }

    /// The topic's samples are not taken any more.
    pub(crate) fn close(&mut self, key: &TopicKey) {
        let of_topic = self.held.iter_mut().filter(|((topic, _), _)| topic == key);
        of_topic.for_each(|(_, held)| held.is_open = false);
    }

    /// Whether one of the topic's has somebody to send to.
    pub(crate) fn is_matched(&self, key: &TopicKey) -> bool {
        self.held.iter().any(|((topic, _), held)| topic == key && held.writer.is_matched())
    }

    /// A topic's samples are taken from now on.
    pub(crate) fn take(&mut self) {
        self.next = Some(Instant::now());
    }

    /// Whether samples are to go through one soon, of topics that are taken.
    pub(crate) fn is_opening(&self) -> bool {
        self.next.is_some_and(|next| Instant::now() >= next)
    }

    /// Opens those of a topic that have found somebody. `open` says whether that was possible; if not, it is tried again later.
    pub(crate) fn open_of(&mut self, key: &TopicKey, open: Open<'_, W>) {
        let now = Instant::now();
        let of_topic = self.held.iter_mut().filter(|((topic, _), _)| topic == key);
        of_topic.for_each(|((_, gid), held)| held.open(key, *gid, now, open));
    }

    /// The same of all topics that are taken.
    pub(crate) fn open_taken(&mut self, is_taken: impl Fn(&TopicKey) -> bool, open: Open<'_, W>) {
        if !self.is_opening() {
            return;
        }
        let now = Instant::now();
        let of_taken = self.held.iter_mut().filter(|((key, _), held)| !held.is_open && is_taken(key));
        self.next = of_taken
            .filter_map(|((key, gid), held)| {
                held.open(key, *gid, now, open);
                (!held.is_open).then(|| held.later.unwrap_or(now))
            })
            .min();
    }
}
