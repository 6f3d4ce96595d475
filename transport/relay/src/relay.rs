// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that takes the samples of all topics.

use crate::route::{Egress, Route, Sources};
use crate::waker::RelayWaker;
use futures::task::waker;
use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Mutex, mpsc};
use std::time::{Duration, Instant};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{JoinHandle, RtError, ThreadBuilder, ThreadInfo};
use tautline_transport::{Gid, Participant, RawSubscription, SamplerSeat, TransportError};

/// Publishers whose samples are not passed on, for somebody else does so.
pub type PassedOver = Arc<Mutex<HashSet<Gid>>>;

/// The thread that takes samples and gives them to an [`Egress`]; dropping it ends it, and with it the egress.
pub struct Relay<O: Egress> {
    commands: Option<mpsc::Sender<Command<O>>>,
    waker: Arc<RelayWaker>,
    passed_over: PassedOver,
    thread: Option<JoinHandle<()>>,
}

/// What the thread is told.
enum Command<O: Egress> {
    Start(O::Key, Box<RawSubscription>, O::Topic, Vec<(Gid, O::Sender)>),
    Open(O::Key, Gid, O::Sender),
    Close(O::Key, Gid),
    Stop(O::Key),
}

/// Why the thread did not start.
#[derive(Debug, thiserror::Error)]
pub enum RelayError {
    /// The doorbell.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The thread.
    #[error(transparent)]
    Rt(#[from] RtError),
}

impl<O: Egress> Relay<O> {
    /// Starts the thread, in the place of the participant's sampler.
    ///
    /// # Errors
    /// [`RelayError`].
    pub fn start(participant: &Participant, thread: ThreadBuilder, egress: O) -> Result<Self, RelayError> {
        let seat = participant.doorbell().claim_sampler().map_err(TransportError::from)?;
        let waker = RelayWaker::new(participant.claim_slot()?);
        let (commands, received) = mpsc::channel();
        let sources = Sources { own: participant.id(), passed_over: PassedOver::default() };
        let passed_over = sources.passed_over.clone();
        let thread = {
            let (waker, routes) = (waker.clone(), HashMap::new());
            thread.spawn(move || {
                move || Loop { seat, commands: received, waker, sources, routes, egress }.run()
            })?
        };
        Ok(Relay { commands: Some(commands), waker, passed_over, thread: Some(thread) })
    }

    /// The thread, as it was read back.
    pub fn info(&self) -> Option<&ThreadInfo> {
        self.thread.as_ref().map(JoinHandle::info)
    }

    /// Takes this topic's samples from now on; of one that is being taken, by this subscription. What publishers have kept comes at once, so
    /// the senders that there are by now come along: see [`open`](Self::open).
    pub fn start_topic(
        &self,
        key: O::Key,
        subscription: RawSubscription,
        topic: O::Topic,
        senders: Vec<(Gid, O::Sender)>,
    ) {
        self.tell(Command::Start(key, Box::new(subscription), topic, senders));
    }

    /// What the publisher `gid` sends goes through `sender`: one of this host, or one elsewhere that somebody else's port stands
    /// for.
    pub fn open(&self, key: O::Key, gid: Gid, sender: O::Sender) {
        self.tell(Command::Open(key, gid, sender));
    }

    /// The publisher `gid` has gone.
    pub fn close(&self, key: O::Key, gid: Gid) {
        self.tell(Command::Close(key, gid));
    }

    /// Takes what there is of this topic, and nothing after that.
    pub fn stop_topic(&self, key: O::Key) {
        self.tell(Command::Stop(key));
    }

    /// Publishers whose samples are not passed on. What comes through a port of this participant is not either: it came from where
    /// the relay's samples go.
    pub fn passed_over(&self) -> &PassedOver {
        &self.passed_over
    }

    fn tell(&self, command: Command<O>) {
        if let Some(commands) = &self.commands {
            let _ = commands.send(command);
            self.waker.ring();
        }
    }
}

impl<O: Egress> Drop for Relay<O> {
    fn drop(&mut self) {
        self.commands = None;
        self.waker.ring();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Loop<O: Egress> {
    seat: SamplerSeat,
    commands: mpsc::Receiver<Command<O>>,
    waker: Arc<RelayWaker>,
    sources: Sources,
    routes: HashMap<O::Key, Route<O>>,
    egress: O,
}

impl<O: Egress> Loop<O> {
    fn run(mut self) {
        const LOOK: Duration = Duration::from_millis(500);
        let mut next_look = Instant::now() + LOOK;
        loop {
            self.waker.drain(&self.seat);
            loop {
                match self.commands.try_recv() {
                    Ok(command) => self.obey(command),
                    Err(mpsc::TryRecvError::Empty) => break,
                    Err(mpsc::TryRecvError::Disconnected) => return,
                }
            }
            let mut is_busy = false;
            for route in self.routes.values_mut() {
                is_busy |= route.serve_if_rung(&self.sources, &mut self.egress);
            }
            if Instant::now() >= next_look {
                next_look = Instant::now() + LOOK;
                self.routes.values_mut().for_each(|route| route.look(&self.sources));
            }
            if !is_busy {
                self.seat.sleep(Some(monotonic_ns() + LOOK.as_nanos() as u64));
            }
        }
    }

    fn obey(&mut self, command: Command<O>) {
        let (sources, egress) = (&self.sources, &mut self.egress);
        match command {
            Command::Start(key, subscription, topic, senders) => {
                let route = match self.routes.entry(key) {
                    Entry::Occupied(route) => {
                        let route = route.into_mut();
                        route.change(subscription, topic, sources, egress);
                        route
                    }
                    Entry::Vacant(place) => {
                        place.insert(Route::new(subscription, topic, waker(self.waker.clone())))
                    }
                };
                senders.into_iter().for_each(|(gid, sender)| route.open(gid, sender, egress));
            }
            Command::Open(key, gid, sender) => {
                if let Some(route) = self.routes.get_mut(&key) {
                    route.open(gid, sender, egress);
                }
            }
            Command::Close(key, gid) => {
                if let Some(route) = self.routes.get_mut(&key) {
                    route.close(gid, sources, egress);
                }
            }
            Command::Stop(key) => {
                if let Some(route) = self.routes.remove(&key) {
                    route.end(sources, egress);
                }
            }
        }
    }
}
