// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge itself: joins both domains, and starts the threads that carry.

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
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::Duration;
use tautline_relay::{
    Budget, Control, Event, Guard, Instance, InstanceError, InstanceLock, Parts, RelayError, Rules, Services,
    watch_domain,
};
use tautline_rt::{JoinHandle, Realtime, RtError, ThreadInfo};
use tautline_transport::{Participant, RemoteGraph, TransportError};

/// What a bridge is to do. Every field has a default.
#[derive(Clone, Debug)]
pub struct Options {
    /// Tautline's domain.
    pub domain: u32,
    /// ROS's domain; `None`: as `ROS_DOMAIN_ID` says, else 0.
    pub ros_domain: Option<u32>,
    /// Which topics.
    pub rules: Rules,
    /// Which services.
    pub services: Rules,
    /// Whether what gateways and other bridges tell of here is put into ROS too.
    pub transit: bool,
    /// `SCHED_FIFO` priority of the threads that carry messages, at least 3: the RMW's threads have the one below it, the
    /// bridge's other threads the one below that. Below the sampler's (90), above the callbacks'.
    pub priority: u8,
    /// Whether that is required.
    pub realtime: Realtime,
    /// Processor time at these priorities; `None` is without a limit.
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

/// Why there is no bridge.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BridgeError {
    /// There is one, which carries what this one would, or its lock cannot be had.
    #[error(transparent)]
    Instance(#[from] InstanceError),
    /// What bridges of one ROS domain tell each other cannot be made.
    #[error("bridges cannot tell each other what they carry: {0}")]
    Table(String),
    /// ROS.
    #[error("{0}; is ROS 2 sourced, and RMW_IMPLEMENTATION unset or one that is installed?")]
    Ros(#[from] RclError),
    /// The domain's shared memory.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A thread.
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

/// A running bridge. Dropping it takes everything back: endpoints, nodes, threads.
pub struct Bridge {
    events: mpsc::SyncSender<Event<()>>,
    state: Arc<BridgeState>,
    wake: Arc<GuardCondition>,
    threads: Vec<JoinHandle<()>>,
    info: Vec<ThreadInfo>,
    guard: Option<Guard>,
    // Before the participant, whose end removes the folder that the lock's file is in.
    _lock: InstanceLock,
    _participant: Participant,
}

/// What is read from outside.
pub(crate) struct BridgeState {
    pub(crate) stop: AtomicBool,
    stats: Mutex<Stats>,
}

impl BridgeState {
    pub(crate) fn stats(&self) -> MutexGuard<'_, Stats> {
        self.stats.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Changes that wait to be looked at; more are the same look.
const EVENTS: usize = 64;

impl Bridge {
    /// Starts a bridge in this process: six threads of its own and the RMW's, none of which the caller's own real-time
    /// threads wait for.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`BridgeError`].
    pub fn spawn(options: Options) -> Result<Self, BridgeError> {
        Self::spawn_in(options, None)
    }

    /// As [`spawn`](Self::spawn), with a lock that was waited for, if it was.
    ///
    /// # Errors
    /// [`BridgeError`].
    pub fn spawn_in(options: Options, lock: Option<InstanceLock>) -> Result<Self, BridgeError> {
        let rmw = rmw_implementation();
        let participant = Participant::new(options.domain)?;
        // From the first port on it is known that they stand for others.
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
        let incoming = Incoming::start(&context, priorities.thread("ros-in"))?;
        let services = RosServices::new(&node)?;
        let services = Services::start(&participant, services, priorities.thread("ros-services"))?;
        let infos = [outgoing.info(), incoming.info(), services.info()];
        let info: Vec<ThreadInfo> = infos.into_iter().flatten().cloned().collect();
        let stats = Stats { domain: options.domain, ros_domain: context.domain(), rmw, ..Stats::default() };
        let state = Arc::new(BridgeState { stop: AtomicBool::new(false), stats: Mutex::new(stats) });
        let (events, received) = mpsc::sync_channel(EVENTS);
        let wake = GuardCondition::new(&context)?;
        let support = table::support()?;
        let own_table = OwnTable::new(&node, &support)?;
        let (tables, heard) = (Tables::default(), table::subscription(&node, &support)?);
        let buffer = SerializedMessage::new()?;
        let threads = Vec::new();
        // From here on what was started ends if something fails.
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
            let control = Control::new(parts);
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

    /// What went through and what did not. Rates are those of the second before.
    pub fn stats(&self) -> Stats {
        let throttled = self.guard.as_ref().map_or(0, Guard::demotions);
        Stats { throttled, ..self.state.stats().clone() }
    }

    /// The bridge's own threads, as they were read back when they started.
    pub fn threads(&self) -> &[ThreadInfo] {
        &self.info
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        self.guard = None;
        self.state.stop.store(true, Ordering::Release);
        // If it does not fit, the control thread has something to look at and will see the flag.
        let _ = self.events.try_send(Event::Stop);
        self.wake.trigger();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// Begins as all bridges' do: what is left of one in ROS after it was killed is known by it.
fn node_name(domain: u32) -> String {
    format!("{BRIDGE_PREFIX}{domain}_{}", std::process::id())
}

/// What tells that something changed in ROS.
struct RosEvents {
    graph: GraphGuard,
    /// Other bridges' tables.
    heard: RosSubscription,
    tables: Tables,
    buffer: SerializedMessage,
}

/// Says when ROS's graph changed, or what other bridges tell.
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
                tracing::error!("changes in ROS are not seen: {error}");
                std::thread::sleep(Duration::from_secs(1));
            }
        }
    }
}
