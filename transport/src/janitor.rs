// SPDX-License-Identifier: MIT OR Apache-2.0
//! The janitor: an ordinary thread of each participant that does what no real-time thread may wait for.
//!
//! - Removes what dead processes left: iceoryx2 nodes, arenas, links, lists of nodes.
//! - Tells this process's publishers and subscriptions when a topic's ports changed without a word, as they do when a
//!   process is killed; finishes a ring that a killed process began.
//! - Looks whether this process is to be traced.
//! - Serves late joiners of transient-local publishers (see [`history`](crate::history)).
//! - Opens doorbells of other processes that a publisher or subscription could not open, rings there, and says why not.
//! - Tells monitors which ends of their topics are on other hosts.
//!
//! Its lock is taken by creating and dropping ports, never by publish or take.

use crate::dead_nodes;
use crate::doorbell::{Doorbell, Owner, remove_stale_arenas};
use crate::error::TransportError;
use crate::graph::Graph;
use crate::history::{Finished, Keeper};
use crate::monitor::RemoteWatch;
use crate::nodes::{self, Registry};
use crate::ports::{self, Reached};
use crate::sync::{Ordering, fence};
use crate::topic::{IoxNode, Topic};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{Policy, Realtime, RtError, ThreadBuilder};

/// How often the janitor looks around when nobody calls it.
const PERIOD: Duration = Duration::from_millis(250);
/// How often it looks for dead processes, which costs milliseconds of system calls.
const CLEANUP_PERIOD: Duration = Duration::from_millis(500);

/// A publisher or subscription of this process that wants to hear of changes of its topic.
pub(crate) struct Watch {
    pub(crate) topic: Arc<Topic>,
    pub(crate) slot: usize,
    pub(crate) is_publisher: bool,
    pub(crate) fingerprint: u64,
    /// The slot's epoch at the last look: a port that came and went between two looks leaves the fingerprint as it was.
    pub(crate) epoch: u32,
    /// When a late joiner no longer waits for histories and takes what is live, which may have been announced before.
    pub(crate) ring_at_ns: Option<u64>,
    /// What a late joiner no longer needs.
    pub(crate) finished: Option<Finished>,
    /// It was said that a doorbell cannot be opened.
    pub(crate) is_warned: bool,
}

#[derive(Default)]
struct Charges {
    watches: Vec<Watch>,
    keepers: Vec<(usize, Keeper)>,
    remote: Vec<RemoteWatch>,
    /// The graph's when the ends on other hosts were last looked for.
    remote_epoch: u32,
}

struct Shared {
    domain: u32,
    doorbell: Arc<Doorbell>,
    graph: Arc<Graph>,
    registry: Arc<Registry>,
    node: Arc<IoxNode>,
    charges: Mutex<Charges>,
    stop: AtomicBool,
}

impl Shared {
    fn charges(&self) -> MutexGuard<'_, Charges> {
        self.charges.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Handle of the janitor thread; dropping it ends the thread and waits for it.
pub(crate) struct Janitor {
    shared: Arc<Shared>,
    thread: Option<tautline_rt::JoinHandle<()>>,
}

impl Janitor {
    pub(crate) fn start(
        domain: u32,
        doorbell: Arc<Doorbell>,
        graph: Arc<Graph>,
        registry: Arc<Registry>,
        node: Arc<IoxNode>,
    ) -> Result<Self, TransportError> {
        let (charges, stop) = (Mutex::default(), AtomicBool::new(false));
        let shared = Arc::new(Shared { domain, doorbell, graph, registry, node, charges, stop });
        let thread = {
            let shared = shared.clone();
            let builder = low_priority_thread("janitor").map_err(TransportError::Janitor)?;
            builder.spawn(move || move || run(&shared)).map_err(TransportError::Janitor)?
        };
        Ok(Janitor { shared, thread: Some(thread) })
    }

    pub(crate) fn watch(&self, watch: Watch) {
        self.shared.charges().watches.push(watch);
    }

    pub(crate) fn keep(&self, slot: usize, keeper: Keeper) {
        self.shared.charges().keepers.push((slot, keeper));
    }

    /// `epoch` is the graph's before `watch` was made.
    pub(crate) fn watch_remote(&self, watch: RemoteWatch, epoch: u32) {
        let mut charges = self.shared.charges();
        charges.remote.retain(RemoteWatch::is_wanted);
        if charges.remote.is_empty() {
            charges.remote_epoch = epoch;
        }
        charges.remote.push(watch);
    }

    /// Forgets everything about the port behind `slot`.
    pub(crate) fn forget(&self, slot: usize) {
        let mut charges = self.shared.charges();
        charges.watches.retain(|watch| watch.slot != slot);
        charges.keepers.retain(|(keeper, _)| *keeper != slot);
    }
}

impl Drop for Janitor {
    fn drop(&mut self) {
        self.shared.stop.store(true, std::sync::atomic::Ordering::Release);
        self.shared.doorbell.arena().call_janitor();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// For what no real-time thread may wait for.
pub(crate) fn low_priority_thread(name: &str) -> Result<ThreadBuilder, RtError> {
    let builder = ThreadBuilder::new(name);
    // One that is nicer already, or batch or idle, stays so: an ordinary user cannot go back.
    Ok(match tautline_rt::current_policy()? {
        Policy::Other { nice: 5.. } | Policy::Unmanaged(_) => builder.realtime(Realtime::Off),
        _ => builder.policy(Policy::Other { nice: 5 }),
    })
}

fn run(shared: &Shared) {
    let mut next_cleanup = Instant::now();
    let word = shared.doorbell.arena().janitor();
    loop {
        // Acquire: pairs with the Release of `call_janitor`; a call after this load ends the wait below at once.
        let calls = word.0.load(Ordering::Acquire);
        if shared.stop.load(std::sync::atomic::Ordering::Acquire) {
            dead_nodes::remove(&shared.node, &shared.graph);
            return;
        }
        look_around(shared);
        look_abroad(shared);
        tautline_trace::attend();
        if Instant::now() >= next_cleanup {
            dead_nodes::remove(&shared.node, &shared.graph);
            remove_stale_arenas(shared.domain);
            nodes::remove_dead_files(shared.domain, &shared.graph);
            tautline_trace::remove_dead_files(shared.domain);
            next_cleanup = Instant::now() + CLEANUP_PERIOD;
        }
        word.wait(calls, Some(monotonic_ns() + PERIOD.as_nanos() as u64));
    }
}

fn look_around(shared: &Shared) {
    let arena = shared.doorbell.arena();
    arena.rescue();
    look_at_ports(shared);
    // Copying histories can take longer than a period.
    let mut next_rescue = Instant::now() + PERIOD;
    let mut rescue = || {
        if Instant::now() >= next_rescue {
            arena.rescue();
            next_rescue = Instant::now() + PERIOD;
        }
    };
    // From the last to the first: when one is forgotten meanwhile, none of the others is missed.
    let keepers = shared.charges().keepers.len();
    for index in (0..keepers).rev() {
        // Locked for each anew: whoever makes or drops a port waits for one at most.
        if let Some((_, keeper)) = shared.charges().keepers.get_mut(index) {
            keeper.serve(&mut rescue);
        }
    }
}

fn look_at_ports(shared: &Shared) {
    let arena = shared.doorbell.arena();
    let mut charges = shared.charges();
    let mut is_marked = false;
    for watch in &mut charges.watches {
        if watch.finished.as_mut().is_some_and(Finished::close) {
            watch.finished = None;
        }
        if shared.doorbell.take_left(watch.slot) {
            match watch.is_publisher {
                true => reach_subscriptions(shared, watch),
                false => reach_publishers(shared, watch),
            }
        }
        if watch.ring_at_ns.is_some_and(|at| monotonic_ns() >= at) {
            watch.ring_at_ns = None;
            arena.bell().mark(watch.slot);
            is_marked = true;
        }
        // The epoch before the ports: whoever changes it after this is seen at the next look.
        let epoch = arena.epoch(watch.slot).load(Ordering::Acquire);
        let now = ports::fingerprint(&watch.topic);
        if now == watch.fingerprint && epoch == watch.epoch {
            continue;
        }
        (watch.fingerprint, watch.epoch) = (now, epoch.wrapping_add(1));
        if !watch.is_publisher {
            release_dead_links(shared, watch);
        }
        arena.advance_epoch(watch.slot);
        // A publisher killed between sending and ringing left samples that nobody announced; a subscription that died
        // may be what an async publish waits for.
        arena.bell().mark(watch.slot);
        is_marked = true;
    }
    // The sampler stands above all callbacks: it wakes once, not once for each port.
    if is_marked {
        fence(Ordering::SeqCst);
        arena.bell().wake_if_sleeping();
    }
}

/// A publisher could not open every subscription's doorbell. What it sent meanwhile is queued there, and it opens them itself when
/// it next publishes: if it can by now, which this finds out.
fn reach_subscriptions(shared: &Shared, watch: &mut Watch) {
    let mut reached = Vec::new();
    for port in ports::subscriptions(&watch.topic.factory) {
        if port.address.arena == shared.doorbell.arena().id() {
            continue;
        }
        match Reached::reach(shared.domain, &shared.doorbell, port.address.arena) {
            Ok(one) => reached.extend(one.map(|one| (one, port.address.slot))),
            Err(error) => {
                warn(watch, "not every subscription is woken for what this publisher sends", &error);
                if ports::may_pass(&error) {
                    shared.doorbell.leave_again(watch.slot);
                }
            }
        }
    }
    if reached.is_empty() {
        return;
    }
    // Before the rings, with a fence between: a sample that its publisher queued before it saw this is found by who is rung.
    shared.doorbell.arena().advance_epoch(watch.slot);
    watch.epoch = watch.epoch.wrapping_add(1);
    for (one, slot) in reached {
        one.arena().bell().ring(slot);
    }
}

/// A keep-all subscription could not open the doorbell of a publisher that waits for room.
fn reach_publishers(shared: &Shared, watch: &mut Watch) {
    for link in shared.doorbell.arena().links(watch.slot) {
        if link.out.waiting.swap(0, Ordering::Relaxed) == 0 {
            continue;
        }
        let (arena, slot) = link.waiter();
        match Reached::reach(shared.domain, &shared.doorbell, arena) {
            Ok(Some(one)) => one.arena().bell().ring(slot),
            // It has gone, and waits no longer.
            Ok(None) => {}
            Err(error) => {
                warn(
                    watch,
                    "a publisher that waits for room in this subscription's queue is not rung",
                    &error,
                );
                link.out.waiting.store(1, Ordering::Relaxed);
                shared.doorbell.leave_again(watch.slot);
            }
        }
    }
}

/// Said once for each publisher or subscription.
fn warn(watch: &mut Watch, what: &str, why: &TransportError) {
    if !std::mem::replace(&mut watch.is_warned, true) {
        tracing::warn!("topic '{}': {what}: {why} (said once)", watch.topic.name);
    }
}

/// Tells monitors of other hosts' ends, if the graph changed since the last time.
fn look_abroad(shared: &Shared) {
    let epoch = {
        let mut charges = shared.charges();
        charges.remote.retain(RemoteWatch::is_wanted);
        let epoch = shared.graph.epoch();
        if charges.remote.is_empty() || charges.remote_epoch == epoch {
            return;
        }
        epoch
    };
    // Files, which may be long: nobody who makes or drops a port waits for them.
    let endpoints = nodes::remote_endpoints(&shared.registry);
    let mut charges = shared.charges();
    charges.remote_epoch = epoch;
    for slot in charges.remote.iter_mut().filter_map(|watch| watch.update(&endpoints, epoch)) {
        shared.doorbell.arena().bell().ring(slot);
    }
}

/// Publishers that were killed did not release their links.
fn release_dead_links(shared: &Shared, watch: &Watch) {
    let arena = shared.doorbell.arena();
    // Claims first, then the list: a publisher is listed before it claims, so that none of these is merely new.
    let links = arena.links(watch.slot).iter();
    let claims: Vec<_> = links.filter_map(|link| Some((link, link.owner()?))).collect();
    let alive = ports::publishers(&watch.topic);
    for (link, owner) in claims {
        if !alive.iter().any(|port| Owner::of(port.gid) == owner) {
            link.release_killed(owner);
        }
    }
}
