// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that carries requests and responses.

use super::offered::{FarServer, Offered};
use super::routes::{OfferedService, Routes, SoughtService};
use super::sought::{FarClient, Sought};
use super::stats::{ServiceStats, ServiceStatsTable};
use crate::mirror::TopicKey;
use crate::rules::Direction;
use crate::waker::Flag;
use crate::worker::{Worker, commanded};
use std::collections::BTreeMap;
use std::sync::{Arc, mpsc};
use std::task::Waker;
use std::time::{Duration, Instant};
use tautline_rt::{PiMutex, RtError, ThreadBuilder, ThreadInfo};
use tautline_transport::{Participant, ServiceType};

/// Interval of checks whether a server on the far side is available.
const SEEK_PERIOD: Duration = Duration::from_millis(20);
/// Interval of checks whether such a server is still available, and of checks for time-outs of requests.
const CHECK_PERIOD: Duration = Duration::from_millis(500);

/// The far side's part in services, owned by the thread.
pub trait FarServices: Send + Sized + 'static {
    /// Receives requests on the far side.
    type Server: FarServer;
    /// Sends requests on the far side.
    type Client: FarClient;
    /// Context for creating servers and clients on the far side.
    type With: Send;

    /// Finds the type of a service of the domain, and returns a function that creates its server on the far side.
    ///
    /// # Errors
    /// Why the service cannot be offered.
    #[allow(clippy::type_complexity, reason = "used once")]
    fn offer<'a>(
        &'a mut self,
        key: &'a TopicKey,
        service: &'a OfferedService,
        with: &'a Self::With,
    ) -> Result<(ServiceType, Box<dyn FnOnce() -> Result<Self::Server, String> + 'a>), String>;

    /// Creates a client of a service of the far side.
    ///
    /// # Errors
    /// Why the service cannot be called.
    fn seek(
        &mut self,
        key: &TopicKey,
        service: &SoughtService,
    ) -> Result<(ServiceType, Self::Client), String>;

    /// Ends the current [`wait`](Self::wait) of the thread, or else the next one.
    fn waker(&self) -> Waker;

    /// Called first, in the services thread.
    fn begin(&mut self) {}

    /// Waits for requests and responses on the far side, or the waker, at most for `timeout` if given.
    ///
    /// # Errors
    /// Why the wait failed.
    fn wait(
        &mut self,
        servers: &[&Self::Server],
        clients: &[&Self::Client],
        timeout: Option<Duration>,
    ) -> Result<Arrived, String>;
}

/// Which servers have requests to take, and which clients responses, in the order of the arguments of [`FarServices::wait`].
pub struct Arrived {
    /// For each server, whether it has a request.
    pub requests: Vec<bool>,
    /// For each client, whether it has a response.
    pub responses: Vec<bool>,
}

/// The services thread; dropping this ends it.
pub struct Services<F: FarServices> {
    worker: Worker<Command<F>>,
    routes: Routes,
    state: Arc<ExchangeState>,
}

struct Command<F: FarServices> {
    routes: Routes,
    with: F::With,
    /// Dropped when the command is executed.
    _done: mpsc::Sender<()>,
}

/// Signals when routes are applied.
pub struct RoutesApplied(Option<mpsc::Receiver<()>>);

impl RoutesApplied {
    /// Waits until the routes are applied, at most for `timeout`. Returns whether they are.
    pub fn wait(self, timeout: Duration) -> bool {
        let timed_out = Err(mpsc::RecvTimeoutError::Timeout);
        self.0.is_none_or(|done| done.recv_timeout(timeout) != timed_out)
    }
}

/// State shared by the thread and its owner.
#[derive(Default)]
struct ExchangeState {
    stats: PiMutex<ServiceStatsTable>,
    /// Services that could not be opened, and why.
    problems: PiMutex<BTreeMap<String, String>>,
}

impl<F: FarServices> Services<F> {
    /// Starts the thread, which the participant's sampler (another thread) wakes.
    ///
    /// # Errors
    /// [`RtError`]: a missing privilege.
    pub fn start(participant: &Participant, far: F, thread: ThreadBuilder) -> Result<Self, RtError> {
        let (state, waker) = (Arc::<ExchangeState>::default(), far.waker());
        let (offered, sought, refused) = Default::default();
        let exchange = Exchange {
            offered,
            sought,
            participant: participant.clone(),
            far,
            waker: waker.clone(),
            state: state.clone(),
            refused,
            checked: Instant::now(),
        };
        let wake = move || waker.wake_by_ref();
        let worker = Worker::start(thread, wake, move |commands| exchange.run(&commands))?;
        Ok(Services { worker, routes: Routes::default(), state })
    }

    /// The thread, as read back at start.
    pub fn info(&self) -> Option<&ThreadInfo> {
        self.worker.info()
    }

    /// Sets the routes, and the context for servers and clients on the far side.
    pub fn set_routes(&mut self, routes: Routes, with: F::With) -> RoutesApplied {
        if routes == self.routes {
            return RoutesApplied(None);
        }
        self.routes = routes.clone();
        let (_done, applied) = mpsc::channel();
        self.worker.send(Command { routes, with, _done });
        RoutesApplied(Some(applied))
    }

    /// The current routes.
    pub fn routes(&self) -> &Routes {
        &self.routes
    }

    /// Services that are not mirrored, and why.
    pub fn problems(&self) -> BTreeMap<String, String> {
        let mut problems = self.routes.problems.clone();
        problems.extend(self.state.problems.lock().clone());
        problems
    }

    /// Retries failed services: memory may be free, or a package installed by now.
    pub fn try_again(&mut self, with: impl FnOnce() -> F::With) {
        if !self.state.problems.lock().is_empty() {
            let routes = std::mem::take(&mut self.routes);
            self.set_routes(routes, with());
        }
    }

    /// Statistics of all services, `elapsed` after the last call.
    pub fn read(&self, elapsed: Duration) -> Vec<ServiceStats<TopicKey, Direction>> {
        self.state.stats.lock().stats(elapsed)
    }
}

struct Exchange<F: FarServices> {
    offered: BTreeMap<TopicKey, Offered<F::Server>>,
    sought: BTreeMap<TopicKey, Sought<F::Client>>,
    participant: Participant,
    far: F,
    waker: Waker,
    state: Arc<ExchangeState>,
    /// Last errors of routes that could not be opened.
    refused: BTreeMap<TopicKey, String>,
    /// When all services were last checked.
    checked: Instant,
}

impl<F: FarServices> Exchange<F> {
    fn run(mut self, commands: &mpsc::Receiver<Command<F>>) {
        self.far.begin();
        loop {
            let mut last = None;
            if !commanded(commands, |command| last = Some(command)) {
                return;
            }
            if let Some(command) = last {
                self.set_routes(&command.routes, &command.with);
            }
            let is_time = self.next_check().is_some_and(|next| next <= Instant::now());
            let is_busy = self.poll(is_time);
            if let Err(error) = self.wait(is_busy) {
                // One log line is enough, and a thread of this priority must not spin.
                tracing::error!("no requests or responses are carried, retrying in 1 s: {error}");
                std::thread::sleep(Duration::from_secs(1));
            }
        }
    }

    /// When to check for changes that nothing signals.
    fn next_check(&self) -> Option<Instant> {
        let is_seeking = self.sought.values().any(Sought::is_seeking);
        let is_waiting = || {
            (F::Client::IS_POLLED && !self.sought.is_empty())
                || self.offered.values().any(Offered::is_waiting)
                || self.sought.values().any(Sought::is_waiting)
        };
        let period = if is_seeking { Some(SEEK_PERIOD) } else { is_waiting().then_some(CHECK_PERIOD) };
        Some(self.checked + period?)
    }

    /// Handles events of the domain. Returns whether there may be more.
    fn poll(&mut self, is_time: bool) -> bool {
        if is_time {
            self.checked = Instant::now();
        }
        let mut is_busy = false;
        let mut refused = Vec::new();
        self.offered.values_mut().for_each(|offered| offered.poll(is_time));
        for (key, sought) in &mut self.sought {
            match sought.poll(is_time) {
                Ok(has_more) => is_busy |= has_more,
                Err(error) => refused.push((key.clone(), error.to_string())),
            }
        }
        for (key, reason) in refused {
            self.sought.remove(&key);
            self.refuse(&key, reason);
        }
        is_busy
    }

    /// Waits, and then takes requests and responses of the far side.
    fn wait(&mut self, is_busy: bool) -> Result<(), String> {
        let timeout = match is_busy {
            true => Some(Duration::ZERO),
            false => self.next_check().map(|next| next.saturating_duration_since(Instant::now())),
        };
        let servers: Vec<&F::Server> = self.offered.values().map(|offered| &offered.far).collect();
        let clients: Vec<&F::Client> = self.sought.values().map(|sought| &sought.far).collect();
        let Arrived { requests, responses } = self.far.wait(&servers, &clients, timeout)?;
        for (offered, _) in self.offered.values_mut().zip(requests).filter(|(_, is_ready)| *is_ready) {
            offered.serve();
        }
        for (sought, _) in self.sought.values_mut().zip(responses).filter(|(_, is_ready)| *is_ready) {
            sought.serve();
        }
        Ok(())
    }

    fn set_routes(&mut self, routes: &Routes, with: &F::With) {
        // A server with another node or definition is another one.
        self.offered.retain(|key, offered| routes.offered.get(key) == Some(&offered.service));
        self.sought.retain(|key, _| routes.sought.contains_key(key));
        self.refused.retain(|key, _| routes.offered.contains_key(key) || routes.sought.contains_key(key));
        self.state.problems.lock().clear();
        for (key, service) in &routes.offered {
            if !self.offered.contains_key(key) {
                let counters = self.state.stats.lock().counters((key.clone(), Direction::Out));
                let (participant, flag) = (&self.participant, Flag::new(self.waker.clone()));
                let offered = self.far.offer(key, service, with).and_then(|(service_type, open)| {
                    Offered::open((key, service), service_type, participant, counters, flag, open)
                });
                match offered {
                    Ok(offered) => drop(self.offered.insert(key.clone(), offered)),
                    Err(reason) => self.refuse(key, reason),
                }
            }
        }
        for (key, service) in &routes.sought {
            if !self.sought.contains_key(key) {
                match self.far.seek(key, service) {
                    Ok((service_type, client)) => {
                        let counters = self.state.stats.lock().counters((key.clone(), Direction::In));
                        let flag = Flag::new(self.waker.clone());
                        let sought =
                            Sought::new(key, service_type, client, &self.participant, counters, flag);
                        self.sought.insert(key.clone(), sought);
                    }
                    Err(reason) => self.refuse(key, reason),
                }
            }
            if let Some(sought) = self.sought.get_mut(key) {
                sought.set_servers(&service.servers);
            }
        }
    }

    /// Stores the reason why a route could not be opened, which is retried, and logs the reason if it changed.
    fn refuse(&mut self, key: &TopicKey, reason: String) {
        if self.refused.get(key) != Some(&reason) {
            tracing::warn!("service '{}' is not mirrored: {reason}", key.topic);
            self.refused.insert(key.clone(), reason.clone());
        }
        self.state.problems.lock().insert(key.topic.clone(), reason);
    }
}
