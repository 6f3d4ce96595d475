// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that carries requests and responses.

use super::offered::Offered;
use super::routes::{Routes, ServiceKey};
use super::sought::Sought;
use super::stats::{Book, ServiceStats};
use super::types::ServiceTypes;
use crate::rcl::{GuardCondition, Node, RclError, SerializedMessage, WaitSet, Waitable};
use crate::stats::Direction;
use futures::task::{ArcWake, waker};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::task::{Context, Waker};
use std::time::Duration;
use tautline_rt::{JoinHandle, RtError, ThreadBuilder, ThreadInfo};
use tautline_transport::{NodeName, Participant};

/// How often it is looked whether a server in ROS is reached.
const SEEK_PERIOD: Duration = Duration::from_millis(20);
/// How often it is looked whether one that is reached still is.
const LOOK_PERIOD: Duration = Duration::from_millis(500);

/// The thread; dropping it ends it.
pub(crate) struct Services {
    commands: Option<mpsc::Sender<Command>>,
    routes: Routes,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// Which services go which way from now on, and the nodes that stand in ROS for Tautline's.
type Command = (Routes, Nodes);
pub(crate) type Nodes = BTreeMap<NodeName, Arc<Node>>;

/// What the thread and its owner both have.
struct Shared {
    guard: Arc<GuardCondition>,
    stop: AtomicBool,
    book: Book,
    /// Services that could not be opened, and why.
    problems: Mutex<BTreeMap<String, String>>,
}

/// Wakes the thread for what happens in Tautline.
struct Bell(Arc<GuardCondition>);

impl ArcWake for Bell {
    fn wake_by_ref(bell: &Arc<Self>) {
        bell.0.trigger();
    }
}

/// Why the thread did not start.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ServicesError {
    #[error(transparent)]
    Rt(#[from] RtError),
    #[error(transparent)]
    Rcl(#[from] RclError),
}

impl Services {
    /// Starts the thread. The participant's sampler, another thread, wakes it.
    pub(crate) fn start(
        participant: &Participant,
        node: &Arc<Node>,
        thread: ThreadBuilder,
    ) -> Result<Self, ServicesError> {
        let guard = GuardCondition::new(node.context())?;
        let shared = Arc::new(Shared {
            guard: guard.clone(),
            stop: AtomicBool::new(false),
            book: Book::default(),
            problems: Mutex::default(),
        });
        let (commands, received) = mpsc::channel();
        let exchange = Exchange {
            participant: participant.clone(),
            node: node.clone(),
            commands: received,
            shared: shared.clone(),
            bell: waker(Arc::new(Bell(guard))),
            wait_set: WaitSet::new(node.context())?,
            buffer: SerializedMessage::new()?,
            types: ServiceTypes::new(),
            offered: BTreeMap::new(),
            sought: BTreeMap::new(),
            refused: BTreeMap::new(),
        };
        let thread = thread.spawn(move || move || exchange.run())?;
        Ok(Services { commands: Some(commands), routes: Routes::default(), shared, thread: Some(thread) })
    }

    /// The thread, as it was read back.
    pub(crate) fn info(&self) -> Option<&ThreadInfo> {
        self.thread.as_ref().map(JoinHandle::info)
    }

    /// Which services go which way from now on. `nodes` stand in ROS for Tautline's: what these offer is theirs.
    pub(crate) fn set_routes(&mut self, routes: Routes, nodes: Nodes) {
        if routes != self.routes {
            self.routes = routes.clone();
            if let Some(commands) = &self.commands {
                // Ignored: the thread ends when this does.
                let _ = commands.send((routes, nodes));
                self.shared.guard.trigger();
            }
        }
    }

    /// As they were set last.
    pub(crate) fn routes(&self) -> &Routes {
        &self.routes
    }

    /// Services that are not bridged, and why.
    pub(crate) fn problems(&self) -> BTreeMap<String, String> {
        let mut problems = self.routes.problems.clone();
        problems.extend(self.shared.problems().clone());
        problems
    }

    /// What could not be opened may be possible now: there is memory, a package was installed.
    pub(crate) fn try_again(&mut self, nodes: impl FnOnce() -> Nodes) {
        if !self.shared.problems().is_empty() {
            let routes = std::mem::take(&mut self.routes);
            self.set_routes(routes, nodes());
        }
    }

    /// What was answered and what was not.
    pub(crate) fn stats(&self) -> Vec<ServiceStats> {
        self.shared.book.read()
    }
}

impl Drop for Services {
    fn drop(&mut self) {
        self.commands = None;
        self.shared.stop.store(true, Ordering::Release);
        self.shared.guard.trigger();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn problems(&self) -> MutexGuard<'_, BTreeMap<String, String>> {
        self.problems.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

struct Exchange {
    participant: Participant,
    node: Arc<Node>,
    commands: mpsc::Receiver<Command>,
    shared: Arc<Shared>,
    bell: Waker,
    wait_set: WaitSet,
    buffer: SerializedMessage,
    types: ServiceTypes,
    offered: BTreeMap<ServiceKey, Offered>,
    sought: BTreeMap<ServiceKey, Sought>,
    /// Why those that are wanted could not be opened last.
    refused: BTreeMap<ServiceKey, String>,
}

impl Exchange {
    fn run(mut self) {
        while !self.shared.stop.load(Ordering::Acquire) {
            if let Some((routes, nodes)) = self.commands.try_iter().last() {
                self.set_routes(&routes, &nodes);
            }
            let is_busy = self.poll();
            if let Err(error) = self.wait(is_busy) {
                // What was said once is enough; a thread of this priority must not spin.
                tracing::error!("services are not bridged: {error}");
                std::thread::sleep(Duration::from_secs(1));
            }
        }
    }

    /// What happened in Tautline. Says whether there may be more.
    fn poll(&mut self) -> bool {
        let mut context = Context::from_waker(&self.bell);
        for offered in self.offered.values_mut() {
            offered.poll(&mut context, &mut self.buffer);
        }
        let mut is_busy = false;
        let mut refused = Vec::new();
        for (key, sought) in &mut self.sought {
            match sought.poll(&mut context, &mut self.buffer) {
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

    /// Waits, and takes what came in ROS.
    fn wait(&mut self, is_busy: bool) -> Result<(), RclError> {
        let timeout = match self.sought.values().any(Sought::is_seeking) {
            _ if is_busy => Some(Duration::ZERO),
            true => Some(SEEK_PERIOD),
            false if self.sought.is_empty() && !self.offered.values().any(Offered::is_waiting) => None,
            false => Some(LOOK_PERIOD),
        };
        let servers = self.offered.values().map(|offered| Waitable::Server(offered.server()));
        let clients = self.sought.values().map(|sought| Waitable::Client(sought.client()));
        let all: Vec<_> = servers.chain(clients).chain([Waitable::Guard(&self.shared.guard)]).collect();
        let ready = self.wait_set.wait(&all, timeout)?;
        let (servers, clients) = ready.split_at(self.offered.len());
        for (offered, _) in self.offered.values_mut().zip(servers).filter(|(_, is_ready)| **is_ready) {
            offered.serve(&mut self.buffer);
        }
        for (sought, _) in self.sought.values_mut().zip(clients).filter(|(_, is_ready)| **is_ready) {
            sought.serve(&mut self.buffer);
        }
        Ok(())
    }

    fn set_routes(&mut self, routes: &Routes, nodes: &Nodes) {
        self.offered.retain(|key, _| routes.offered.contains_key(key));
        self.sought.retain(|key, _| routes.sought.contains_key(key));
        self.refused.retain(|key, _| routes.offered.contains_key(key) || routes.sought.contains_key(key));
        self.shared.problems().clear();
        for (key, service) in &routes.offered {
            if !self.offered.contains_key(key) {
                let node =
                    service.node.as_ref().and_then(|name| nodes.get(name)).unwrap_or(&self.node).clone();
                let counters = self.shared.book.counters(key, Direction::ToRos);
                let types = self.types.find(&key.type_name, service.type_hash.as_deref());
                match types.and_then(|types| Offered::open(key, &types, &self.participant, &node, counters)) {
                    Ok(offered) => drop(self.offered.insert(key.clone(), offered)),
                    Err(error) => self.refuse(key, error.to_string()),
                }
            }
        }
        for (key, service) in &routes.sought {
            if !self.sought.contains_key(key) {
                let counters = self.shared.book.counters(key, Direction::FromRos);
                let types = self.types.find(&key.type_name, service.type_hash.as_deref());
                match types
                    .and_then(|types| Sought::open(key, &types, &self.participant, &self.node, counters))
                {
                    Ok(sought) => drop(self.sought.insert(key.clone(), sought)),
                    Err(error) => self.refuse(key, error.to_string()),
                }
            }
            if let Some(sought) = self.sought.get_mut(key) {
                sought.set_servers(&service.servers);
            }
        }
    }

    /// It is tried again now and then, and said when it is another reason.
    fn refuse(&mut self, key: &ServiceKey, reason: String) {
        if self.refused.get(key) != Some(&reason) {
            tracing::warn!("service '{}' is not bridged: {reason}", key.service);
            self.refused.insert(key.clone(), reason.clone());
        }
        self.shared.problems().insert(key.service.clone(), reason);
    }
}
