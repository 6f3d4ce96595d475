// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge: joins both domains and starts its threads.

use crate::error::BridgeError;
use crate::incoming::Incoming;
use crate::options::Options;
use crate::outgoing::{Outgoing, Ros};
use crate::rcl::{
    Context, GraphGuard, GuardCondition, Node, RosSubscription, SerializedMessage, WaitSet, Waitable,
    rmw_implementation,
};
use crate::ros::RosSide;
use crate::ros_graph::BRIDGE_PREFIX;
use crate::services::RosServices;
use crate::stats::{BridgeState, Stats};
use crate::table::{self, OwnTable, Tables};
use crate::threads;
use std::sync::atomic::Ordering;
use std::sync::{Arc, mpsc};
use std::time::Duration;
use tautline_relay::{
    Event, Guard, Instance, InstanceLock, Latest, MirrorControl, Parts, Services, watch_domain,
};
use tautline_rt::{JoinHandle, Realtime, ThreadInfo};
use tautline_transport::{Participant, RemoteGraph};

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
            BridgeState { stats: Latest::new(stats), stop: Default::default(), returned: Default::default() };
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
        Stats { throttled, returned, ..(*self.state.stats.get()).clone() }
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

/// The name of this bridge's node. All bridges' node names have a common prefix, which identifies leftovers of a killed bridge in ROS.
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
