// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge: joins both domains and starts its threads.

use crate::incoming::Incoming;
use crate::outgoing::{Outgoing, Ros};
use crate::rcl::{
    Context, GraphGuard, GuardCondition, Node, RclError, RosSubscription, SerializedMessage, WaitSet,
    Waitable, rmw_implementation,
};
use crate::ros::RosSide;
use crate::ros_graph::BRIDGE_PREFIX;
use crate::services::RosServices;
use crate::stats::Stats;
use crate::table::{self, OwnTable, Tables};
use crate::threads;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::Duration;
use tautline_relay::{
    Budget, Event, Guard, Instance, InstanceError, InstanceLock, MirrorControl, Parts, RelayError, Rules,
    Services, watch_domain,
};
use tautline_rt::{JoinHandle, Realtime, RtError, ThreadInfo};
use tautline_transport::{Participant, RemoteGraph, TransportError};

/// Options of a bridge. Every field has a default.
#[derive(Clone, Debug)]
pub struct Options {
    /// Tautline's domain.
    pub domain: u32,
    /// ROS's domain; `None`: `ROS_DOMAIN_ID`, else 0.
    pub ros_domain: Option<u32>,
    /// The topics to bridge.
    pub rules: Rules,
    /// The services to bridge.
    pub services: Rules,
    /// Whether endpoints that gateways and other bridges announce in the domain are mirrored into ROS.
    pub transit: bool,
    /// `SCHED_FIFO` priority of the threads that carry messages, at least 3. The RMW's threads run one below, the bridge's
    /// other threads two below. It must be below the sampler's (90) and above the callbacks'.
    pub priority: u8,
    /// Whether real-time priorities are required.
    pub realtime: Realtime,
    /// Processor budget at these priorities; `None`: no limit.
    pub budget: Option<Budget>,
}

impl Options {
    /// Default of [`Options::priority`].
    pub const PRIORITY: u8 = 80;
    /// Default of [`Options::budget`]: half a core.
    pub const BUDGET: Budget = Budget { percent: 50 };
}

impl Default for Options {
    fn default() -> Self {
        let rules = Rules { auto: true, ..Rules::default() };
        Options {
            domain: 0,
            ros_domain: None,
            services: rules.clone(),
            rules,
            transit: true,
            priority: Self::PRIORITY,
            realtime: Realtime::Required,
            budget: Some(Self::BUDGET),
        }
    }
}

/// Why a bridge could not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BridgeError {
    /// Another bridge already joins these domains, or the lock file failed.
    #[error(transparent)]
    Instance(#[from] InstanceError),
    /// The type support for the table that bridges exchange could not be loaded.
    #[error("bridges cannot announce their endpoints to each other: {0}")]
    Table(String),
    /// rcl or the RMW failed.
    #[error("{0}; source ROS 2, and unset RMW_IMPLEMENTATION or set it to an installed RMW")]
    Ros(#[from] RclError),
    /// Shared memory of the domain failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A thread could not start.
    #[error(transparent)]
    Threads(#[from] RtError),
}

impl From<RelayError> for BridgeError {
    fn from(error: RelayError) -> Self {
        match error {
            RelayError::Transport(error) => error.into(),
            RelayError::Rt(error) => error.into(),
        }
    }
}

/// A running bridge. Dropping it removes its endpoints and nodes and ends its threads.
pub struct Bridge {
    events: mpsc::SyncSender<Event<()>>,
    state: Arc<BridgeState>,
    wake: Arc<GuardCondition>,
    threads: Vec<JoinHandle<()>>,
    info: Vec<ThreadInfo>,
    guard: Option<Guard>,
    // Dropped before the participant, which removes the folder of the lock file.
    _lock: InstanceLock,
    _participant: Participant,
}

/// State that [`Bridge`] reads.
pub(crate) struct BridgeState {
    pub(crate) stop: AtomicBool,
    /// [`Stats::returned`].
    pub(crate) returned: AtomicU64,
    stats: Mutex<Stats>,
}

impl BridgeState {
    pub(crate) fn stats(&self) -> MutexGuard<'_, Stats> {
        self.stats.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Capacity of the event queue. If it is full, the graphs are read anyway.
const EVENTS: usize = 64;

impl Bridge {
    /// Starts a bridge in this process: six threads of its own and the RMW's. The caller's real-time threads wait for none of
    /// them.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`BridgeError`].
    pub fn spawn(options: Options) -> Result<Self, BridgeError> {
        Self::spawn_in(options, None)
    }

    /// Like [`spawn`](Self::spawn), with a lock from [`Instance::wait`], if given.
    ///
    /// # Errors
    /// [`BridgeError`].
    pub fn spawn_in(options: Options, lock: Option<InstanceLock>) -> Result<Self, BridgeError> {
        let rmw = rmw_implementation();
        let participant = Participant::new(options.domain)?;
        // Marks the participant as one that mirrors others, before its first port appears.
        participant.set_remote(&RemoteGraph::default())?;
        let before = tautline_rt::threads()?;
        let context = Context::new(options.ros_domain)?;
        let instance = Instance::bridge(options.domain, context.domain());
        let lock = lock.map_or_else(|| instance.lock(), Ok)?;
        let node = Node::new(&context, &node_name(options.domain), "/")?;
        let priorities = threads::Priorities::new(options.priority, options.realtime);
        let rmw_threads = threads::started_since(&before)?;
        priorities.set(&rmw_threads)?;

        let outgoing = Outgoing::start(&participant, priorities.thread("ros-out"), Ros::new()?)?;
        let stats = Stats { domain: options.domain, ros_domain: context.domain(), rmw, ..Stats::default() };
        let state =
            BridgeState { stats: Mutex::new(stats), stop: Default::default(), returned: Default::default() };
        let state = Arc::new(state);
        let incoming = Incoming::start(&context, state.clone(), priorities.thread("ros-in"))?;
        let services = RosServices::new(&node)?;
        let services = Services::start(&participant, services, priorities.thread("ros-services"))?;
        let infos = [outgoing.info(), incoming.info(), services.info()];
        let info: Vec<ThreadInfo> = infos.into_iter().flatten().cloned().collect();
        let (events, received) = mpsc::sync_channel(EVENTS);
        let wake = GuardCondition::new(&context)?;
        let support = table::support()?;
        let own_table = OwnTable::new(&node, &support)?;
        let (tables, heard) = (Tables::default(), table::subscription(&node, &support)?);
        let buffer = SerializedMessage::new()?;
        let threads = Vec::new();
        // From here on, an error ends the threads that have started.
        let guard = match (options.realtime, options.budget) {
            (Realtime::Required, Some(budget)) => Some(priorities.watch(budget, &rmw_threads)?),
            _ => None,
        };
        let mut bridge = Bridge {
            events,
            state,
            wake,
            threads,
            info,
            guard,
            _lock: lock,
            _participant: participant.clone(),
        };
        let control = {
            let state = bridge.state.clone();
            let tables = (tables.clone(), own_table);
            let (far, transit) =
                RosSide::new(&options, &participant, node.clone(), incoming, tables, state.clone());
            let (participant, relay) = (participant.clone(), outgoing);
            let (rules, service_rules) = (options.rules, options.services);
            let parts = Parts { participant, far, relay, services, transit, rules, service_rules };
            let control = MirrorControl::new(parts);
            priorities.thread("ros-control").spawn(move || move || control.run(&received, &state.stop))?
        };
        bridge.hold(control);
        let here = {
            let (events, state) = (bridge.events.clone(), bridge.state.clone());
            priorities
                .thread("ros-here")
                .spawn(move || move || watch_domain(&participant, &events, &state.stop))?
        };
        bridge.hold(here);
        let there = {
            let (graph, wait_set) = (GraphGuard::of(&node), WaitSet::new(&context)?);
            let (wake, events, state) = (bridge.wake.clone(), bridge.events.clone(), bridge.state.clone());
            priorities.thread("ros-there").spawn(move || {
                move || {
                    let ros_events = RosEvents { graph, heard, tables, buffer };
                    watch_ros(ros_events, wait_set, &wake, &events, &state);
                }
            })?
        };
        bridge.hold(there);
        Ok(bridge)
    }

    fn hold(&mut self, thread: JoinHandle<()>) {
        self.info.push(thread.info().clone());
        self.threads.push(thread);
    }

    /// Statistics. Rates are those of the last second.
    pub fn stats(&self) -> Stats {
        let throttled = self.guard.as_ref().map_or(0, Guard::demotions);
        let returned = self.state.returned.load(Ordering::Relaxed);
        Stats { throttled, returned, ..self.state.stats().clone() }
    }

    /// The bridge's own threads, with the policies read back at start.
    pub fn threads(&self) -> &[ThreadInfo] {
        &self.info
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        self.guard = None;
        self.state.stop.store(true, Ordering::Release);
        // If the queue is full, the control thread wakes anyway and sees the flag.
        let _ = self.events.try_send(Event::Stop);
        self.wake.trigger();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// All bridges' node names have this prefix, which identifies leftovers of a killed bridge in ROS.
fn node_name(domain: u32) -> String {
    format!("{BRIDGE_PREFIX}{domain}_{}", std::process::id())
}

/// Sources of changes in ROS.
struct RosEvents {
    graph: GraphGuard,
    /// Other bridges' tables.
    heard: RosSubscription,
    tables: Tables,
    buffer: SerializedMessage,
}

/// Wakes the control thread when ROS's graph or another bridge's table changed.
fn watch_ros(
    mut ros_events: RosEvents,
    mut wait_set: WaitSet,
    wake: &GuardCondition,
    events: &mpsc::SyncSender<Event<()>>,
    state: &BridgeState,
) {
    while !state.stop.load(Ordering::Acquire) {
        let all = [
            Waitable::Subscription(&ros_events.heard),
            Waitable::Graph(&ros_events.graph),
            Waitable::Guard(wake),
        ];
        let woken = wait_set.wait(&all, None).map(drop);
        match woken.and_then(|()| ros_events.tables.take(&mut ros_events.heard, &mut ros_events.buffer)) {
            Ok(()) => drop(events.try_send(Event::FarChange(()))),
            Err(error) => {
                tracing::error!("changes of the ROS graph are not seen, retrying in 1 s: {error}");
                std::thread::sleep(Duration::from_secs(1));
            }
        }
    }
}
