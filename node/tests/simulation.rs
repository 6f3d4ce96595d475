// SPDX-License-Identifier: MIT OR Apache-2.0
//! The analysis's bounds are held against a simulation of the runtime; here that simulation is held against the runtime. Small random systems run
//! in both: every message that the simulation has arrive is published, every job lasts until the simulation ends it, and the runtime
//! begins the same jobs, with the same messages, in the same order. Times play no part. `TAUT_SEED` chooses the systems.

mod common;
#[path = "../../analysis/tests/runtime/mod.rs"]
mod runtime;

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::time::{Duration, Instant};

use common::{Number, context, cores, eventually, isolate, realtime, spin};
use futures::StreamExt;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use runtime::machine::{Seen, Step};
use runtime::made_up::{Budget, Callback, Matching, Model, Order, age_penalty};
use runtime::small::{HERE, KEPT, SLEEPING, callback, group, run, sensors};
use tautline::join::{
    ApproximateEpsilonTime, ApproximateTime, ExactTime, JoinCounters, LatestTime, Policy as JoinPolicy,
    RateSynchronizer, Synchronizer, all_of,
};
use tautline::{
    CallbackGroup, CallbackHandle, CallbackOptions, Context, Limits, Node, Publisher, Qos, Realtime, Sample,
    Subscription,
};
use tautline_rt::{PiGuard, PiMutex, Policy, clock, current_policy, policy_of, set_policy};

/// The resources of a core.
const LOCKS: usize = 2;
/// Far more than a job needs while it waits for the simulation.
const BUDGET: Duration = Duration::from_millis(60);
/// Of those that are suspended: long enough for what others do meanwhile.
const PERIOD: Duration = Duration::from_millis(400);

/// How often a system is tried that the machine does not keep up with.
const ATTEMPTS: usize = 5;

fn join(rng: &mut StdRng) -> Model {
    let from_one = rng.random_bool(0.3);
    let mut model = sensors(rng, 3, from_one);
    let sensors: Vec<usize> = (usize::from(from_one)..model.callbacks.len()).collect();
    let window = rng.random_range(1..4_000);
    let matching = match rng.random_range(0..4) {
        _ if from_one => Matching::Exact,
        0 => Matching::Newest,
        1 => Matching::Approximate(window),
        2 => Matching::Epsilon(window),
        _ => Matching::LatestTime,
    };
    let (wcet, depth) = (rng.random_range(1..4_000), rng.random_range(1..=4));
    let one = Callback { wcet, depth, join: Some((matching, 1)), ..callback(HERE, sensors) };
    model.callbacks.push(one);
    model
}

/// A thread for each sensor, by priority, some of them held to their budgets, some with locks that inherit priority.
fn threads(rng: &mut StdRng) -> Model {
    let mut model = sensors(rng, 3, false);
    for sensor in 0..model.callbacks.len() {
        let wcet = rng.random_range(1..=model.callbacks[sensor].period * 2 / 3);
        let budget = [Budget::Tell, Budget::Demote, Budget::Demote, Budget::End][rng.random_range(0..4)];
        let priority = 20 + 2 * ((sensor as u8 * 2 + rng.random_range(0..2)) % 7);
        let mut locks = Vec::new();
        if rng.random_bool(0.8) {
            locks.push((usize::from(rng.random_bool(0.2)), rng.random_range(wcet.div_ceil(2)..=wcet)));
        }
        let one = Callback {
            locks,
            wcet,
            budget,
            priority,
            depth: rng.random_range(1..=4),
            ..callback(HERE, vec![sensor])
        };
        model.callbacks.push(one);
    }
    model
}

/// A thread for each sensor, by priority, some of them suspended when they have used up their budgets.
fn sleepers(rng: &mut StdRng) -> Model {
    let mut model = sensors(rng, 3, false);
    for sensor in 0..model.callbacks.len() {
        let wcet = rng.random_range(1..=model.callbacks[sensor].period * 2 / 3);
        let budget = if rng.random_bool(0.5) { Budget::Suspend } else { Budget::Tell };
        let (priority, depth) = (20 + 2 * ((sensor as u8 + 1) % 3), rng.random_range(1..=4));
        model.callbacks.push(Callback { wcet, budget, priority, depth, ..callback(HERE, vec![sensor]) });
    }
    model
}

/// A topic's message: its number, and its stamp above it.
const fn packed(number: u64, stamp: u64) -> u64 {
    stamp << 32 | number
}

fn number(sample: &Sample<Number>) -> u64 {
    sample.value & 0xFFFF_FFFF
}

fn stamp(sample: &Sample<Number>) -> i64 {
    (sample.value >> 32) as i64
}

fn released(sample: &Sample<Number>) -> u64 {
    sample.info().released_ns
}

/// What the simulation has a job do.
enum Command {
    UseUpTheBudget,
    Lock(usize),
    Unlock(usize),
    End,
}

#[derive(Clone)]
struct Jobs {
    callback: usize,
    happened: Sender<Step>,
    locks: Arc<[Lock; LOCKS]>,
}

#[derive(Default)]
struct Lock {
    lock: PiMutex<()>,
    /// The callback that has it, plus 1; cleared just before it is given back.
    holder: AtomicUsize,
}

impl Jobs {
    /// Runs until the simulation ends it: without rights to real-time priorities asleep, else as work.
    fn run(&self, orders: &Receiver<Command>, numbers: Vec<u64>, works: bool) {
        let callback = self.callback;
        let _ = self.happened.send(Step::Begun { callback, numbers });
        let mut held: [Option<PiGuard<'_, ()>>; LOCKS] = Default::default();
        loop {
            let order = match works {
                true => orders.try_recv(),
                false => orders.recv().map_err(|_| TryRecvError::Disconnected),
            };
            match order {
                Err(TryRecvError::Empty) => std::hint::spin_loop(),
                Ok(Command::Lock(lock)) => {
                    held[lock] = Some(self.locks[lock].lock.lock());
                    self.locks[lock].holder.store(callback + 1, Ordering::SeqCst);
                    let _ = self.happened.send(Step::Locked { callback, lock });
                }
                Ok(Command::Unlock(lock)) => {
                    self.locks[lock].holder.store(0, Ordering::SeqCst);
                    held[lock] = None;
                }
                Ok(Command::End) | Err(TryRecvError::Disconnected) => return,
                Ok(Command::UseUpTheBudget) => {
                    while !matches!(current_policy().unwrap(), Policy::Other { .. }) {
                        clock::burn_cpu(Duration::from_micros(100));
                    }
                }
            }
        }
    }
}

/// The part of a system that is looked at, in the runtime.
struct Real {
    /// Jobs end when these are dropped, which is first, or the node would wait for them.
    orders: HashMap<usize, Sender<Command>>,
    publishers: HashMap<(usize, usize), Publisher<Number>>,
    happened: Receiver<Step>,
    callbacks: HashMap<usize, CallbackHandle>,
    counters: Option<Arc<JoinCounters>>,
    locks: Arc<[Lock; LOCKS]>,
    _node: Node,
}

impl Real {
    fn new(context: &Context, scenario: usize, model: &Model, seen: &Seen) -> Real {
        let mut node = Node::create(context.clone(), &format!("scenario{scenario}"), "").unwrap();
        let (happens, happened) = channel();
        let here = (0..model.callbacks.len()).filter(|i| model.callbacks[*i].core == HERE);
        let (mut publishers, mut orders_of, mut callbacks) = (HashMap::new(), HashMap::new(), HashMap::new());
        let mut counters = None;
        let mut group = CallbackGroup::new();
        let locks = Arc::new(<[Lock; LOCKS]>::default());
        for i in here {
            let callback = &model.callbacks[i];
            let mut subscribe = |topic: usize| {
                let name = format!("/s{scenario}/c{i}/t{topic}");
                let qos = Qos::keep_last(callback.depth);
                node.set_topic_limits(&name, Limits { held: KEPT + 2, ..Limits::default() }).unwrap();
                let subscription = node.subscribe::<Number>(&name, qos).unwrap();
                publishers.insert((i, topic), node.create_publisher::<Number>(&name, qos).unwrap());
                subscription
            };
            let inputs: Vec<Subscription<Number>> =
                callback.triggers.iter().map(|topic| subscribe(*topic)).collect();
            let (sender, orders) = channel();
            orders_of.insert(i, sender);
            let jobs = Jobs { callback: i, happened: happens.clone(), locks: locks.clone() };
            if let Some((matching, _)) = callback.join {
                let times = seen.steps.iter().filter(|(_, step)| matches!(step, Step::Taken { .. }));
                let times = times.map(|(at, _)| *at).collect();
                let (handle, of_join) = spawn_join(&mut node, matching, times, inputs, jobs, orders);
                callbacks.insert(i, handle);
                counters = Some(of_join);
                continue;
            }
            let Ok([subscription]) = <[Subscription<Number>; 1]>::try_from(inputs) else {
                panic!("one topic")
            };
            if callback.group.is_some() {
                group.add(format!("c{i}"), subscription, released, move |sample| {
                    jobs.run(&orders, vec![number(&sample)], false);
                    async {}
                });
                continue;
            }
            let options = CallbackOptions::fifo(callback.priority).core(cores()[0]).name(format!("c{i}"));
            let options = match callback.budget {
                Budget::Demote => options.budget(BUDGET).demote_on_overrun(),
                Budget::End => options.budget(BUDGET).end_on_overrun(),
                Budget::Suspend => options.budget(BUDGET).period(PERIOD).suspend_on_overrun(),
                _ => options,
            };
            let work = subscription.for_each(move |sample| {
                jobs.run(&orders, vec![number(&sample)], true);
                async {}
            });
            callbacks.insert(i, node.spawn_callback(options, work).unwrap());
        }
        if callbacks.is_empty() {
            let handle = node.spawn_group(CallbackOptions::other().name("group"), group).unwrap();
            callbacks.insert(usize::MAX, handle);
        }
        Real { _node: node, publishers, orders: orders_of, happened, callbacks, counters, locks }
    }

    /// Does what the simulation did, and compares what the runtime makes of it. Returns whether it kept up: a thread is suspended for a part of
    /// [`PERIOD`], in which a machine that does much else may not get to what happens meanwhile.
    fn follow(self, model: &Model, seen: &Seen, context: &str) -> bool {
        // Above the jobs that work until it tells them to end.
        let own = current_policy().unwrap();
        if model.callbacks.iter().any(|callback| callback.priority < SLEEPING) {
            set_policy(Policy::Fifo(70)).unwrap();
        }
        let from = clock::monotonic_ns() - 1_000_000_000;
        let (mut taken, mut ended) = (HashMap::new(), HashMap::new());
        let mut waits_for_lock = Vec::new();
        let mut suspended = HashMap::new();
        let tell = |callback: usize, command| self.orders[&callback].send(command).unwrap();
        let mut before = Vec::new();
        for (at, step) in seen.steps.clone() {
            before.push((at, step.clone()));
            match step {
                Step::Arrived { callback, topic, number, stamp } => {
                    let mut loan = self.publishers[&(callback, topic)].loan().unwrap();
                    loan.value = packed(number, stamp);
                    match model.callbacks[callback].group {
                        Some(_) => loan.publish_released_at(from + at * 1_000).unwrap(),
                        None => loan.publish().unwrap(),
                    };
                }
                Step::Taken { callback, topic } => {
                    let input =
                        model.callbacks[callback].triggers.iter().position(|of| *of == topic).unwrap();
                    let count = taken.entry(input).or_insert(0);
                    *count += 1;
                    let counters = self.counters.as_ref().unwrap();
                    eventually("a join takes a message", || counters.inputs()[input].received() >= *count);
                }
                Step::Blocked { callback, lock, .. } => {
                    tell(callback, Command::Lock(lock));
                    waits_for_lock.push(callback);
                }
                Step::Unlocked { callback, lock } => {
                    tell(callback, Command::Unlock(lock));
                    let holder = &self.locks[lock].holder;
                    eventually("a lock is given back", || holder.load(Ordering::SeqCst) != callback + 1);
                }
                Step::Begun { .. } | Step::Locked { .. } => {
                    if let Step::Locked { callback, lock } = step
                        && waits_for_lock.extract_if(.., |waits| *waits == callback).next().is_none()
                    {
                        tell(callback, Command::Lock(lock));
                    }
                    let happened = self.happened.recv_timeout(Duration::from_secs(30));
                    let is_late = |since: &Instant| since.elapsed() > PERIOD - BUDGET;
                    if happened.as_ref() != Ok(&step) && suspended.values().any(is_late) {
                        println!("late: {happened:?} instead of {step:?}, {suspended:?}");
                        self.end(own);
                        return false;
                    }
                    assert_eq!(happened.as_ref(), Ok(&step), "the last of {before:?}: {context}");
                }
                Step::Demoted { callback } => {
                    tell(callback, Command::UseUpTheBudget);
                    let thread = self.callbacks[&callback].thread().tid;
                    let is_demoted = || matches!(policy_of(thread), Ok(Policy::Other { .. }));
                    eventually("a job is demoted", is_demoted);
                }
                // It works until it has used up its budget.
                Step::Suspended { callback, .. } => {
                    let thread = self.callbacks[&callback].thread().tid;
                    eventually("a job is suspended", || is_asleep(thread));
                    suspended.insert(callback, Instant::now());
                }
                Step::Resumed { callback } => {
                    let thread = self.callbacks[&callback].thread().tid;
                    eventually("a job goes on", || !is_asleep(thread));
                    suspended.remove(&callback);
                }
                Step::Ended { callback } => {
                    tell(callback, Command::End);
                    if let Some(handle) = self.callbacks.get(&callback) {
                        let count = ended.entry(callback).or_insert(0);
                        *count += 1;
                        let stats = handle.stats();
                        let is_join = model.callbacks[callback].join.is_some();
                        eventually("a job ends", || is_join || stats.completions() >= *count);
                    }
                }
            }
        }
        for (callback, expected) in model.callbacks.iter().zip(&seen.unused) {
            // A join at the pace of the fastest reads the others. While a job is open, the runtime has yet to decide on the next set.
            let is_idle = matches!(seen.steps.last(), Some((_, Step::Taken { .. })));
            if is_idle && callback.join.is_some_and(|(matching, _)| matching != Matching::LatestTime) {
                let inputs = self.counters.as_ref().unwrap().inputs();
                let unused = || inputs.iter().map(|input| [input.dropped(), input.refused()]);
                eventually(&format!("{expected:?} dropped and refused, {context}"), || {
                    unused().eq(expected.iter().copied())
                });
            }
        }
        let more = self.end(own);
        // A thread that is told to stop may just have taken one more.
        assert!(more.len() <= model.callbacks.len(), "{more:?}");
        true
    }

    /// Stops it, with this thread's own policy again. Returns what has happened since.
    fn end(self, own: Policy) -> Vec<Step> {
        set_policy(own).unwrap();
        self.callbacks.values().for_each(CallbackHandle::stop);
        drop(self.orders);
        self.callbacks.into_values().for_each(|callback| callback.join().unwrap());
        self.happened.try_iter().collect()
    }
}

/// Whether a thread of this process sleeps.
fn is_asleep(thread: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/self/task/{thread}/stat")).unwrap();
    stat.rsplit_once(") ").unwrap().1.starts_with('S')
}

type Joined = (CallbackHandle, Arc<JoinCounters>);

fn spawn_join(
    node: &mut Node,
    matching: Matching,
    times: Vec<u64>,
    inputs: Vec<Subscription<Number>>,
    jobs: Jobs,
    orders: Receiver<Command>,
) -> Joined {
    macro_rules! spawn {
        ($stream:expr, $($input:ident),+) => {{
            let stream = $stream.unwrap();
            let counters = stream.counters();
            let work = stream.for_each(move |($($input,)+)| {
                jobs.run(&orders, vec![$(number(&$input)),+], false);
                async {}
            });
            (node.spawn_callback(CallbackOptions::other().name("join"), work).unwrap(), counters)
        }};
    }
    macro_rules! join {
        ($($input:ident),+) => {{
            let inputs = ($($input,)+);
            let policy: Box<dyn JoinPolicy + Send + Unpin> = match matching {
                Matching::Newest => return spawn!(all_of(inputs), $($input),+),
                Matching::LatestTime => {
                    let mut times = times.into_iter();
                    let clock = move || times.next().unwrap_or(0) as i64;
                    return spawn!(RateSynchronizer::new(LatestTime::new(), clock, inputs), $($input),+);
                }
                Matching::Exact => Box::new(ExactTime::new(KEPT)),
                Matching::Approximate(window) => {
                    let policy = ApproximateTime::new(KEPT).max_interval(Duration::from_nanos(window));
                    Box::new(policy.age_penalty(age_penalty(window)))
                }
                Matching::Epsilon(window) => {
                    Box::new(ApproximateEpsilonTime::new(KEPT, Duration::from_nanos(window)))
                }
            };
            spawn!(Synchronizer::new(Boxed(policy), inputs), $($input),+)
        }};
    }
    let mut inputs = inputs.into_iter().map(|input| input.stamped_by(stamp as fn(&Sample<Number>) -> i64));
    let mut next = || inputs.next().unwrap();
    let (a, b) = (next(), next());
    match inputs.next() {
        None => join!(a, b),
        Some(c) => join!(a, b, c),
    }
}

/// Any policy.
struct Boxed(Box<dyn JoinPolicy + Send + Unpin>);

impl JoinPolicy for Boxed {
    fn queue_size(&self) -> usize {
        self.0.queue_size()
    }

    fn start(&mut self, inputs: usize) {
        self.0.start(inputs);
    }

    fn arrived(&mut self, input: usize, stamp_ns: i64) -> tautline::join::Arrival {
        self.0.arrived(input, stamp_ns)
    }

    fn decide(&mut self, drop: &mut dyn FnMut(usize)) -> bool {
        self.0.decide(drop)
    }

    fn clear(&mut self) {
        self.0.clear();
    }
}

/// Runs some systems in both, and says how much of what was compared.
fn compare(context: &Context, seed: u64, systems: usize, make: fn(&mut StdRng) -> Model) {
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut begun, mut lost, mut demoted, mut suspended, mut blocked, mut unused) = (0, 0, 0, 0, 0, 0);
    for scenario in 0..systems {
        let (model, seen) = run(&mut rng, make);
        for (_, step) in &seen.steps {
            begun += usize::from(matches!(step, Step::Begun { .. }));
            demoted += usize::from(matches!(step, Step::Demoted { .. }));
            suspended += usize::from(matches!(step, Step::Suspended { .. }));
            blocked += usize::from(matches!(step, Step::Blocked { .. }));
        }
        lost += seen.lost.values().sum::<u64>();
        unused += seen.unused.iter().flatten().flatten().sum::<u64>();
        let says = format!("seed {seed}, system {scenario}: {:?}", &model.callbacks);
        let mut attempts = (0..ATTEMPTS).map(|attempt| scenario + attempt * systems);
        let is_compared =
            attempts.any(|number| Real::new(context, number, &model, &seen).follow(&model, &seen, &says));
        assert!(is_compared, "the machine does too much else: {says}");
    }
    println!(
        "{systems} systems: {begun} jobs begin in one order, {lost} messages overwritten, {unused} dropped or refused by joins, {demoted} demoted, \
         {suspended} suspended, {blocked} waited for locks"
    );
    assert!(begun > 5 * systems);
}

#[test]
fn a_group_begins_what_the_simulation_begins() {
    let seed = tautline_seed::seed();
    let context = context(231);
    let _spinning = spin(&context);
    compare(&context, seed, 30, |rng| group(rng, Order::Fifo));
}

#[test]
fn a_join_makes_the_sets_of_the_simulation() {
    let seed = tautline_seed::seed();
    let context = context(232);
    let _spinning = spin(&context);
    compare(&context, seed, 40, join);
}

/// With rights to real-time priorities.
fn compare_threads(domain: u32, systems: usize, make: fn(&mut StdRng) -> Model) {
    if !realtime() {
        return;
    }
    let seed = tautline_seed::seed();
    isolate();
    let context = Context::builder().domain(domain).realtime(Realtime::Required).build().unwrap();
    let _spinning = spin(&context);
    compare(&context, seed, systems, make);
}

#[test]
fn threads_begin_in_the_order_of_the_simulation() {
    compare_threads(229, 20, threads);
}

#[test]
fn suspended_threads_sleep_and_go_on_as_in_the_simulation() {
    compare_threads(228, 6, sleepers);
}
