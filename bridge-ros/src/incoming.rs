// SPDX-License-Identifier: MIT OR Apache-2.0
//! From ROS to shared memory: one thread waits for all subscriptions and takes from each until it is empty.
//!
//! So there is one queue, the RMW's, and its depth is the QoS's: between it and the loan is no channel that could
//! overflow. A message is taken into a buffer of rmw's, checked there, and copied once, into a loan.

use crate::bridge::BridgeError;
use crate::outgoing::ENCAPSULATION;
use crate::rcl::{
    Context, GuardCondition, RclError, RosMessageInfo, RosSubscription, SerializedMessage, WaitSet, Waitable,
};
use crate::ros_graph::NAME_TIME;
use std::collections::HashMap;
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tautline_relay::{Delivery, EarlyLimits, InKey, Ingress, IngressUpdate, Job, Source, Worker, commanded};
use tautline_rt::{ThreadBuilder, ThreadInfo};
use tautline_transport::Gid;

/// Messages taken of one topic before the next topic has its turn.
const TURN: usize = 64;
/// How messages come. Those of publishers that are not known yet are waited for longer than it takes to give up the name of a
/// publisher's node, and the next look at the graph.
pub(crate) const DELIVERY: Delivery = Delivery {
    early: Some(EarlyLimits {
        samples: 1000,
        bytes: 64 << 20,
        time: NAME_TIME.saturating_add(Duration::from_secs(3)),
    }),
    is_ordered: true,
};
/// How often it is looked whether something has waited long enough.
const LOOK: Duration = Duration::from_secs(1);

/// How long a subscription is kept beside the one that replaces it: publishers have found that by then, which they tell nobody.
const RENEWAL_TIME: Duration = Duration::from_secs(3);

/// Publishers of a topic whose last time is remembered, of an RMW that gives no numbers.
const MOST_PUBLISHERS: usize = 4096;

/// The thread that takes from ROS; dropping it ends it.
pub(crate) struct Incoming {
    worker: Worker<Job<Loop>>,
}

impl Incoming {
    pub(crate) fn start(context: &Arc<Context>, thread: ThreadBuilder) -> Result<Self, BridgeError> {
        let guard = GuardCondition::new(context)?;
        let (wait_set, buffer) = (WaitSet::new(context)?, SerializedMessage::new()?);
        let incoming = Loop { guard: guard.clone(), wait_set, buffer, routes: Vec::new() };
        let worker = Worker::start(thread, move || guard.trigger(), move |jobs| incoming.run(&jobs))?;
        Ok(Incoming { worker })
    }

    /// The thread, as it was read back.
    pub(crate) fn info(&self) -> Option<&ThreadInfo> {
        self.worker.info()
    }

    /// Takes from now on; in place of what the key had.
    pub(crate) fn open(&self, key: InKey, subscription: RosSubscription, ingress: Ingress) {
        self.worker.tell(Box::new(move |incoming| incoming.open(key, subscription, ingress)));
    }

    pub(crate) fn change(&self, key: InKey, change: IngressUpdate) {
        self.worker.tell(Box::new(move |incoming| {
            if let Some((_, route)) = incoming.routes.iter_mut().find(|(other, _)| *other == key) {
                route.ingress.change(change);
            }
        }));
    }

    pub(crate) fn close(&self, key: InKey) {
        self.worker.tell(Box::new(move |incoming| drop(incoming.end(&key))));
    }
}

struct Loop {
    guard: Arc<GuardCondition>,
    wait_set: WaitSet,
    buffer: SerializedMessage,
    routes: Vec<(InKey, Route)>,
}

struct Route {
    subscription: RosSubscription,
    ingress: Ingress,
    /// Subscriptions before this one, the oldest first, and until when they are taken from: who keeps nothing for late joiners
    /// does not send to the new one before they have found each other.
    previous: Vec<(RosSubscription, Instant)>,
    /// Of an RMW that gives no numbers: when each publisher's last message was published.
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
                    // What was said once is enough; a thread of this priority must not spin.
                    tracing::error!("nothing comes from ROS: {error}");
                    std::thread::sleep(Duration::from_secs(1));
                    continue;
                }
            };
            for (_, route) in &mut self.routes {
                let is_ready =
                    ready.by_ref().take(route.subscriptions().count()).fold(false, |any, one| any | one);
                if is_ready || route.has_more {
                    route.serve(&mut self.buffer);
                }
                route.look();
            }
        }
    }

    fn open(&mut self, key: InKey, subscription: RosSubscription, ingress: Ingress) {
        let (previous, last) = Default::default();
        let mut route = Route { subscription, ingress, previous, last, has_more: true };
        if let Some(old) = self.end(&key) {
            route.take_over(old, key.is_kept());
        }
        self.routes.push((key, route));
    }

    /// What arrived before still goes through, or is left over.
    fn end(&mut self, key: &InKey) -> Option<Route> {
        let at = self.routes.iter().position(|(other, _)| other == key)?;
        let (_, mut route) = self.routes.swap_remove(at);
        // Bounded, for a publisher could be faster than this.
        for _ in 0..64 {
            route.serve(&mut self.buffer);
            if !route.has_more {
                break;
            }
        }
        Some(route)
    }
}

impl Route {
    /// In the order in which they are taken from.
    fn subscriptions(&self) -> impl Iterator<Item = &RosSubscription> {
        self.previous.iter().map(|(subscription, _)| subscription).chain([&self.subscription])
    }

    /// Goes on where the other ended.
    fn take_over(&mut self, old: Route, is_kept: bool) {
        if !is_kept {
            self.previous = old.previous;
            self.previous.push((old.subscription, Instant::now() + RENEWAL_TIME));
            self.last = old.last;
        }
        self.ingress.take_over(old.ingress, is_kept);
    }

    /// Takes and passes on what is there, at most a turn of it.
    fn serve(&mut self, buffer: &mut SerializedMessage) {
        for _ in 0..TURN {
            match self.take(buffer) {
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

    /// From previous subscriptions first: what the new one has follows on it. What both get is told by its number, or by when it was
    /// published if the RMW gives none.
    fn take(&mut self, buffer: &mut SerializedMessage) -> Result<Option<RosMessageInfo>, RclError> {
        for (previous, _) in &mut self.previous {
            if let Some(info) = previous.take(buffer)? {
                return Ok(Some(info));
            }
        }
        self.subscription.take(buffer)
    }

    fn receive(&mut self, bytes: &[u8], info: RosMessageInfo) {
        if info.is_own || self.ingress.leaves(&info.gid) {
            return;
        }
        if info.sequence_number.is_none() {
            // Of publishers that have gone, most of them.
            if self.last.len() >= MOST_PUBLISHERS {
                self.last.clear();
            }
            let last = self.last.entry(info.gid).or_insert(i64::MIN);
            if !self.previous.is_empty() && info.source_timestamp_ns <= *last {
                return;
            }
            *last = info.source_timestamp_ns;
        }
        let source = Source {
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

    /// What has waited long enough goes.
    fn look(&mut self) {
        // Not before it was empty.
        if !self.has_more {
            self.previous.retain(|(_, until)| Instant::now() < *until);
        }
        self.ingress.look();
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

/// The body, if it is one that can be read in place.
fn body(bytes: &[u8]) -> Result<&[u8], Dropped> {
    // The last two bytes are options, which say how much padding follows.
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
