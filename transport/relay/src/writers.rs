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

    /// Opens those of topics that are meant which have found somebody: what was sent before would be lost. One that finds nobody, while
    /// others of its topic do, does not keep its samples waiting for ever. `make` makes what their samples go through; if it cannot, that
    /// is tried again later.
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

    /// Notes when it is to be looked again at those that are not open, of topics that are taken.
    pub(crate) fn look_later(&mut self, is_taken: impl Fn(&TopicKey) -> bool) {
        let closed = self.held.iter().filter(|((key, _), held)| !held.is_open && is_taken(key));
        self.next = closed.map(|(_, held)| held.later.unwrap_or_else(Instant::now)).min();
    }
}
