// SPDX-License-Identifier: MIT OR Apache-2.0
//! From ROS to shared memory: one thread waits for all subscriptions and takes from each until it is empty.
//!
//! The RMW's queue is the only one, with the depth of the QoS: there is no second queue before the loan that could overflow. A
//! message is taken into a buffer of rmw's, validated there, and copied once, into a loan.

use crate::error::BridgeError;
use crate::outgoing::ENCAPSULATION;
use crate::rcl::{
    Context, GuardCondition, RclError, RosMessageInfo, RosSubscription, SerializedMessage, WaitSet, Waitable,
};
use crate::stats::BridgeState;
use crate::table::NAME_TIME;
use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tautline_relay::{
    Delivery, EarlyLimits, InKey, Ingress, IngressUpdate, Job, MessageMeta, Worker, commanded,
};
use tautline_rt::{ThreadBuilder, ThreadInfo};
use tautline_transport::Gid;

/// Messages taken from one topic before the next topic's turn.
const TURN: usize = 64;
/// Messages of publishers that are not discovered yet are held for longer than the time-out for the name of a publisher's node
/// plus the next read of the graph.
pub(crate) const DELIVERY: Delivery = Delivery {
    early: Some(EarlyLimits {
        samples: 1000,
        bytes: 64 << 20,
        time: NAME_TIME.saturating_add(Duration::from_secs(3)),
    }),
    is_ordered: true,
};
/// Interval of the check for expired waits.
const LOOK: Duration = Duration::from_secs(1);

/// How long a replaced subscription is kept. By then publishers have discovered the new one; DDS does not signal that.
const RENEWAL_TIME: Duration = Duration::from_secs(3);

/// Maximum of publishers per topic whose last time stamp is stored, for an RMW without sequence numbers.
const MOST_PUBLISHERS: usize = 4096;

/// The thread that takes from ROS; dropping this ends it.
pub(crate) struct Incoming {
    worker: Worker<Job<Loop>>,
}

impl Incoming {
    pub(crate) fn start(
        context: &Arc<Context>,
        state: Arc<BridgeState>,
        thread: ThreadBuilder,
    ) -> Result<Self, BridgeError> {
        let guard = GuardCondition::new(context)?;
        let (wait_set, buffer) = (WaitSet::new(context)?, SerializedMessage::new()?);
        let incoming = Loop { state, guard: guard.clone(), wait_set, buffer, routes: Vec::new() };
        let worker = Worker::start(thread, move || guard.trigger(), move |jobs| incoming.run(&jobs))?;
        Ok(Incoming { worker })
    }

    /// The thread, as read back at start.
    pub(crate) fn info(&self) -> Option<&ThreadInfo> {
        self.worker.info()
    }

    /// Takes from `subscription` from now on, in place of the key's previous route.
    pub(crate) fn open(&self, key: InKey, subscription: RosSubscription, ingress: Ingress) {
        self.worker.send(Box::new(move |incoming| incoming.open(key, subscription, ingress)));
    }

    pub(crate) fn change(&self, key: InKey, change: IngressUpdate) {
        self.worker.send(Box::new(move |incoming| {
            if let Some((_, route)) = incoming.routes.iter_mut().find(|(other, _)| *other == key) {
                route.ingress.change(change);
            }
        }));
    }

    pub(crate) fn close(&self, key: InKey) {
        self.worker.send(Box::new(move |incoming| drop(incoming.end(&key))));
    }
}

struct Loop {
    state: Arc<BridgeState>,
    guard: Arc<GuardCondition>,
    wait_set: WaitSet,
    buffer: SerializedMessage,
    routes: Vec<(InKey, IngressRoute)>,
}

struct IngressRoute {
    subscription: RosSubscription,
    ingress: Ingress,
    /// Replaced subscriptions, the oldest first, and until when each is still taken from: a volatile publisher does not send to
    /// the new one before both have matched.
    previous: Vec<(RosSubscription, Instant)>,
    /// For an RMW without sequence numbers: the source time stamp of each publisher's last message.
    last: HashMap<Gid, i64>,
    /// Whether a turn ended before the queue was empty.
    has_more: bool,
}

impl Loop {
    fn run(mut self, jobs: &mpsc::Receiver<Job<Self>>) {
        while commanded(jobs, |job| job(&mut self)) {
            let is_busy = self.routes.iter().any(|(_, route)| route.has_more);
            let is_waiting =
                self.routes.iter().any(|(_, route)| route.ingress.is_waiting() || !route.previous.is_empty());
            let timeout = match (is_busy, is_waiting) {
                (true, _) => Some(Duration::ZERO),
                (_, true) => Some(LOOK),
                _ => None,
            };
            let subscriptions = self.routes.iter().flat_map(|(_, route)| route.subscriptions());
            let all: Vec<_> =
                subscriptions.map(Waitable::Subscription).chain([Waitable::Guard(&self.guard)]).collect();
            let mut ready = match self.wait_set.wait(&all, timeout) {
                Ok(ready) => ready.iter(),
                Err(error) => {
                    // One log line is enough, and a thread of this priority must not spin.
                    tracing::error!("no messages are taken from ROS, retrying in 1 s: {error}");
                    std::thread::sleep(Duration::from_secs(1));
                    continue;
                }
            };
            for (_, route) in &mut self.routes {
                let is_ready =
                    ready.by_ref().take(route.subscriptions().count()).fold(false, |any, one| any | one);
                if is_ready || route.has_more {
                    route.serve(&mut self.buffer, &self.state);
                }
                route.drop_expired();
            }
        }
    }

    fn open(&mut self, key: InKey, subscription: RosSubscription, ingress: Ingress) {
        let (previous, last) = Default::default();
        let mut route = IngressRoute { subscription, ingress, previous, last, has_more: true };
        if let Some(old) = self.end(&key) {
            route.take_over(old, key.is_kept());
        }
        self.routes.push((key, route));
    }

    /// Ends a route. Messages that have arrived are still forwarded or dropped.
    fn end(&mut self, key: &InKey) -> Option<IngressRoute> {
        let at = self.routes.iter().position(|(other, _)| other == key)?;
        let (_, mut route) = self.routes.swap_remove(at);
        // Bounded, because a publisher could be faster.
        for _ in 0..64 {
            route.serve(&mut self.buffer, &self.state);
            if !route.has_more {
                break;
            }
        }
        Some(route)
    }
}

impl IngressRoute {
    /// The route's subscriptions, in the order in which messages are taken.
    fn subscriptions(&self) -> impl Iterator<Item = &RosSubscription> {
        self.previous.iter().map(|(subscription, _)| subscription).chain([&self.subscription])
    }

    /// Continues where the old route ended.
    fn take_over(&mut self, old: IngressRoute, is_kept: bool) {
        if !is_kept {
            self.previous = old.previous;
            self.previous.push((old.subscription, Instant::now() + RENEWAL_TIME));
            self.last = old.last;
        }
        self.ingress.take_over(old.ingress, is_kept);
    }

    /// Takes and forwards what has arrived, at most one turn.
    fn serve(&mut self, buffer: &mut SerializedMessage, state: &BridgeState) {
        for _ in 0..TURN {
            match self.take(buffer) {
                Ok(Some(info)) if info.is_own => {
                    state.returned.fetch_add(1, Ordering::Relaxed);
                }
                Ok(Some(info)) => self.receive(buffer.bytes(), info),
                Ok(None) => return self.has_more = false,
                Err(error) => {
                    self.ingress.counters().dropped(error.reason);
                    return self.has_more = false;
                }
            }
        }
        self.has_more = true;
    }

    /// Takes from replaced subscriptions first, because the new one continues after them. Duplicates are found by sequence
    /// number, or by source time stamp if the RMW has none.
    fn take(&mut self, buffer: &mut SerializedMessage) -> Result<Option<RosMessageInfo>, RclError> {
        for (previous, _) in &mut self.previous {
            if let Some(info) = previous.take(buffer)? {
                return Ok(Some(info));
            }
        }
        self.subscription.take(buffer)
    }

    fn receive(&mut self, bytes: &[u8], info: RosMessageInfo) {
        if self.ingress.ignores(&info.gid) {
            return;
        }
        if info.sequence_number.is_none() {
            // Most entries belong to publishers that have ended.
            if self.last.len() >= MOST_PUBLISHERS {
                self.last.clear();
            }
            let last = self.last.entry(info.gid).or_insert(i64::MIN);
            if !self.previous.is_empty() && info.source_timestamp_ns <= *last {
                return;
            }
            *last = info.source_timestamp_ns;
        }
        let source = MessageMeta {
            publisher: info.gid,
            number: info.sequence_number,
            are_numbers_whole: true,
            timestamp_ns: info.source_timestamp_ns,
        };
        match body(bytes) {
            Ok(body) => self.ingress.receive(body, source),
            Err(reason) => self.ingress.counters().dropped(reason),
        }
    }

    /// Ends expired waits.
    fn drop_expired(&mut self) {
        // Only when the queue was empty.
        if !self.has_more {
            self.previous.retain(|(_, until)| Instant::now() < *until);
        }
        self.ingress.drop_expired();
    }
}

/// Why a message from ROS was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
enum Dropped {
    #[error("shorter than its encapsulation")]
    Short,
    #[error("big endian, which is not converted")]
    BigEndian,
    #[error("encapsulated as XCDR2 or as a parameter list, not as XCDR1")]
    Encapsulation,
}

/// The body, if it can be read in place.
fn body(bytes: &[u8]) -> Result<&[u8], Dropped> {
    // The last two bytes are options: the length of the padding.
    match bytes {
        [kind, encoding, _, _, body @ ..] if [*kind, *encoding] == ENCAPSULATION[..2] => Ok(body),
        [0, 0, _, _, ..] => Err(Dropped::BigEndian),
        [_, _, _, _, ..] => Err(Dropped::Encapsulation),
        _ => Err(Dropped::Short),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_xcdr1_is_refused_with_its_reason() {
        assert_eq!(body(&[0, 1, 0, 3, 7]), Ok(&[7][..]));
        assert_eq!(body(&[0, 1, 0, 0]), Ok(&[][..]));
        assert_eq!(body(&[0, 0, 0, 0, 7]), Err(Dropped::BigEndian));
        for kind in [2, 3, 6, 7, 8, 9, 10, 11] {
            assert_eq!(body(&[0, kind, 0, 0, 7]), Err(Dropped::Encapsulation));
        }
        assert_eq!(body(&[1, 1, 0, 0]), Err(Dropped::Encapsulation));
        for len in 0..4 {
            assert_eq!(body(&[0, 1, 0, 0][..len]), Err(Dropped::Short));
        }
    }
}
