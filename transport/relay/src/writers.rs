// SPDX-License-Identifier: MIT OR Apache-2.0
//! The writers that mirror publishers on the far side, and whether they have matched.

use crate::mirror::TopicKey;
use std::collections::HashMap;
use std::time::{Duration, Instant};
use tautline_transport::Gid;

/// How long a new writer is polled often for matches; later, with each tick.
pub(crate) const MATCH_TIME: Duration = Duration::from_secs(3);

/// Writers by topic and mirrored publisher.
pub struct Writers<W> {
    held: HashMap<(TopicKey, Gid), OpenedWriter<W>>,
    /// Next check for writers to open.
    next: Option<Instant>,
}

struct OpenedWriter<W> {
    writer: W,
    opened: Instant,
    /// Whether samples are sent through it.
    is_open: bool,
    /// After a failure: when it is retried.
    later: Option<Instant>,
}

/// Delay of a retry.
const LATER: Duration = Duration::from_secs(1);

/// Mirrors a publisher of the domain.
pub trait FarWriter: Send {
    /// Whether it has matched: samples sent before are lost.
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
        self.held
            .insert((key, gid), OpenedWriter { writer, opened: Instant::now(), is_open: false, later: None });
    }

    pub(crate) fn remove(&mut self, key: &TopicKey, gid: Gid) {
        self.held.remove(&(key.clone(), gid));
    }

    /// Writers that `is_right` rejects.
    pub(crate) fn others(&self, is_right: impl Fn(&Gid, &W) -> bool) -> Vec<(TopicKey, Gid)> {
        let others = self.held.iter().filter(|((_, gid), held)| !is_right(gid, &held.writer));
        others.map(|(of, _)| of.clone()).collect()
    }

    /// All writers, each with its publisher.
    pub fn iter(&self) -> impl Iterator<Item = (&TopicKey, Gid, &W)> {
        self.held.iter().map(|((key, gid), held)| (key, *gid, &held.writer))
    }

    /// Like [`iter`](Self::iter).
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (&TopicKey, &mut W)> {
        self.held.iter_mut().map(|((key, _), held)| (key, &mut held.writer))
    }

    /// The topic's samples are no longer taken.
    pub(crate) fn close(&mut self, key: &TopicKey) {
        let of_topic = self.held.iter_mut().filter(|((topic, _), _)| topic == key);
        of_topic.for_each(|(_, held)| held.is_open = false);
    }

    /// Whether one of the topic's writers has matched.
    pub(crate) fn is_matched(&self, key: &TopicKey) -> bool {
        self.held.iter().any(|((topic, _), held)| topic == key && held.writer.is_matched())
    }

    /// A topic's samples are taken from now on.
    pub(crate) fn take(&mut self) {
        self.next = Some(Instant::now());
    }

    /// Whether a check for writers to open is due.
    pub(crate) fn is_opening(&self) -> bool {
        self.next.is_some_and(|next| Instant::now() >= next)
    }

    /// Opens matched writers of topics for which `is_meant`: samples sent before a match would be lost. A writer without a match
    /// opens after `MATCH_TIME`, so that it does not hold its samples forever. `make` creates the sender; if that fails, it is
    /// retried later.
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

    /// Sets the time of the next check, for topics that are taken.
    pub(crate) fn schedule_check(&mut self, is_taken: impl Fn(&TopicKey) -> bool) {
        let closed = self.held.iter().filter(|((key, _), held)| !held.is_open && is_taken(key));
        self.next = closed.map(|(_, held)| held.later.unwrap_or_else(Instant::now)).min();
    }
}
