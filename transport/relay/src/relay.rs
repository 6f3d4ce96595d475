// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that takes the samples of all topics.

use crate::route::{Egress, PassedOver, Served, Sources, TopicRoute};
use crate::waker::RelayWaker;
use crate::worker::{Job, Worker, commanded};
use futures::task::waker;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{RtError, ThreadBuilder, ThreadInfo};
use tautline_transport::{Gid, Participant, RawSubscription, SamplerSeat, TransportError};

/// The thread that takes samples and passes them to an [`Egress`]; dropping this ends both, after the remaining samples of
/// [stopped topics](Self::stop_topic).
pub struct Relay<O: Egress> {
    worker: Worker<Job<Loop<O>>>,
    passed_over: PassedOver,
}

/// Why the thread did not start.
#[derive(Debug, thiserror::Error)]
pub enum RelayError {
    /// The doorbell failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The thread could not start.
    #[error(transparent)]
    Rt(#[from] RtError),
}

impl<O: Egress> Relay<O> {
    /// Starts the thread, in the place of the participant's sampler.
    pub fn start(participant: &Participant, thread: ThreadBuilder, egress: O) -> Result<Self, RelayError> {
        let seat = participant.doorbell().claim_sampler().map_err(TransportError::from)?;
        let waker = RelayWaker::new(participant.claim_slot()?);
        let sources = Sources { own: participant.id(), passed_over: PassedOver::default() };
        let passed_over = sources.passed_over.clone();
        let relay =
            Loop { seat, waker: waker.clone(), sources, routes: HashMap::new(), ending: Vec::new(), egress };
        let worker = Worker::start(thread, move || waker.ring(), move |jobs| relay.run(&jobs))?;
        Ok(Relay { worker, passed_over })
    }

    /// The thread, as read back at start.
    pub fn info(&self) -> Option<&ThreadInfo> {
        self.worker.info()
    }

    /// Takes this topic's samples through `subscription` from now on, in place of an earlier one. Kept samples arrive at once, so
    /// `senders` must contain the senders that already exist: see [`open`](Self::open).
    pub fn start_topic(
        &self,
        key: O::Key,
        subscription: RawSubscription,
        topic: O::Topic,
        senders: Vec<(Gid, O::Sender)>,
    ) {
        let subscription = Box::new(subscription);
        self.worker.send(Box::new(move |relay| relay.start(key, subscription, topic, senders)));
    }

    /// Forwards samples of the publisher `gid` through `sender`. The publisher may be of this host, or mirrored by another
    /// participant's port.
    pub fn open(&self, key: O::Key, gid: Gid, sender: O::Sender) {
        self.worker.send(Box::new(move |Loop { routes, egress, .. }| {
            if let Some(route) = routes.get_mut(&key) {
                route.open(gid, sender, egress);
            }
        }));
    }

    /// Removes the sender of the publisher `gid`, which has ended, after its remaining samples. What cannot be sent within
    /// seven seconds is counted.
    pub fn close(&self, key: O::Key, gid: Gid) {
        self.worker.send(Box::new(move |Loop { routes, .. }| {
            if let Some(route) = routes.get_mut(&key) {
                route.close(gid);
            }
        }));
    }

    /// Takes the topic's remaining samples, then stops.
    pub fn stop_topic(&self, key: O::Key) {
        self.worker.send(Box::new(move |Loop { routes, ending, .. }| {
            if let Some(mut route) = routes.remove(&key) {
                route.end();
                ending.push(route);
            }
        }));
    }

    /// Publishers whose samples are not forwarded. Samples from ports of this participant are not forwarded either, because they came
    /// from the far side.
    pub fn passed_over(&self) -> &PassedOver {
        &self.passed_over
    }
}

struct Loop<O: Egress> {
    seat: SamplerSeat,
    waker: Arc<RelayWaker>,
    sources: Sources,
    routes: HashMap<O::Key, TopicRoute<O>>,
    /// Of stopped topics, until their remaining samples are forwarded.
    ending: Vec<TopicRoute<O>>,
    egress: O,
}

impl<O: Egress> Loop<O> {
    fn run(mut self, jobs: &mpsc::Receiver<Job<Self>>) {
        const REFRESH_PERIOD: Duration = Duration::from_millis(500);
        /// The period while a topic waits for room.
        const BLOCKED_PERIOD: Duration = Duration::from_millis(5);
        let mut next_check = Instant::now() + REFRESH_PERIOD;
        loop {
            self.waker.drain(&self.seat);
            let has_ended = !commanded(jobs, |job| job(&mut self));
            let (sources, egress) = (&self.sources, &mut self.egress);
            let routes = self.routes.values_mut().chain(&mut self.ending);
            let served = routes.map(|route| route.serve_if_rung(sources, egress)).max();
            self.ending.retain_mut(|route| !route.is_over(&self.sources));
            if has_ended && self.ending.is_empty() {
                return;
            }
            if Instant::now() >= next_check {
                next_check = Instant::now() + REFRESH_PERIOD;
                self.routes.values_mut().for_each(|route| route.refresh(&self.sources));
            }
            let timeout = match served {
                Some(Served::Some) => continue,
                Some(Served::Blocked) => BLOCKED_PERIOD,
                Some(Served::All) | None => REFRESH_PERIOD,
            };
            self.seat.sleep(Some(monotonic_ns() + timeout.as_nanos() as u64));
        }
    }

    fn start(
        &mut self,
        key: O::Key,
        subscription: Box<RawSubscription>,
        topic: O::Topic,
        senders: Vec<(Gid, O::Sender)>,
    ) {
        let egress = &mut self.egress;
        let route = match self.routes.entry(key) {
            Entry::Occupied(route) => {
                let route = route.into_mut();
                route.change(subscription, topic);
                route
            }
            Entry::Vacant(place) => {
                place.insert(TopicRoute::new(subscription, topic, waker(self.waker.clone())))
            }
        };
        senders.into_iter().for_each(|(gid, sender)| route.open(gid, sender, egress));
    }
}
