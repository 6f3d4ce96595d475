// SPDX-License-Identifier: MIT OR Apache-2.0
//! The cores, step by step.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};

use super::made_up::{Budget, Callback, Matching, Model, Order, group_priority, longer};
use super::waiting::Waiting;

/// How long a run of a random system takes.
const UNTIL: u64 = 1_500;
/// Of a synchronizer that never drops anything for want of room.
const ENDLESS: usize = 1_000;

/// What a run does: other phases, delays and execution times for each seed.
#[derive(Clone)]
pub struct Run {
    pub seed: u64,
    /// When the first release of each callback is due.
    pub phases: Vec<u64>,
    /// Until when each callback publishes nothing: its node starts later than others.
    pub silent_until: Vec<u64>,
    /// Whether jobs that are held to their budgets exceed them.
    pub is_wild: bool,
    pub stalls: bool,
    /// How many messages of a topic each join keeps, if jobs exceed budgets or nodes start late.
    pub queue_sizes: Vec<usize>,
    pub until: u64,
}

/// What happens on the way, for another runtime to be held against.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// A message of a topic, by its number, with its stamp.
    Arrived {
        callback: usize,
        topic: usize,
        number: u64,
        stamp: u64,
    },
    /// A join has taken a message.
    Taken {
        callback: usize,
        topic: usize,
    },
    /// A job, with the numbers of its messages.
    Begun {
        callback: usize,
        numbers: Vec<u64>,
    },
    /// It has used up its budget.
    Demoted {
        callback: usize,
    },
    /// It has used up its budget, and sleeps until then.
    Suspended {
        callback: usize,
        until: u64,
    },
    /// It has its next budget.
    Resumed {
        callback: usize,
    },
    /// It waits for a lock that another holds.
    Blocked {
        callback: usize,
        lock: usize,
        is_demoted: bool,
    },
    Locked {
        callback: usize,
        lock: usize,
    },
    Unlocked {
        callback: usize,
        lock: usize,
    },
    Ended {
        callback: usize,
    },
}

impl Run {
    /// Together at first, or anywhere.
    pub fn random(model: &Model, rng: &mut StdRng) -> Run {
        let together = rng.random_range(0..200);
        let phase = |callback: &Callback| {
            let phase = if rng.random_bool(0.6) { together } else { rng.random_range(0..callback.period) };
            phase % callback.period
        };
        let phases = model.callbacks.iter().map(phase).collect();
        let (seed, queue_sizes) = (rng.random(), Vec::new());
        let mut silent_until = vec![0; model.callbacks.len()];
        if rng.random_bool(0.3) {
            for until in &mut silent_until {
                *until = rng.random_range(0..UNTIL / 3) * rng.random_range(0..3) / 2;
            }
        }
        Run { phases, seed, silent_until, is_wild: false, stalls: false, queue_sizes, until: UNTIL }
    }

    /// One phase a little different, or anywhere; or other times at the same phases.
    pub fn changed(&self, model: &Model, rng: &mut StdRng) -> Run {
        let mut run = self.clone();
        let i = rng.random_range(0..run.phases.len());
        let period = model.callbacks[i].period;
        match rng.random_range(0..4) {
            3 => run.silent_until[i] = rng.random_range(0..UNTIL / 3),
            0 => run.seed = rng.random(),
            1 => run.phases[i] = rng.random_range(0..period),
            _ => {
                run.phases[i] =
                    (run.phases[i] + [1, 2, period - 1, period - 2][rng.random_range(0..4)]) % period
            }
        }
        run
    }
}

/// The worst of what was seen, in steps.
pub struct Seen {
    pub responses: Vec<u64>,
    pub queues: Vec<usize>,
    pub queues_without_stall: Vec<usize>,
    pub latencies: Vec<u64>,
    pub ages: Vec<u64>,
    pub reactions: Vec<u64>,
    /// Of each topic that a join waits for, by callback.
    pub waits: Vec<Vec<u64>>,
    /// How many messages of one topic wait in each join.
    pub held: Vec<usize>,
    /// Whether each stage of a chain triggers the next.
    pub is_direct: Vec<bool>,
    /// Whether what reflects an event can be told: joins on the way take a topic from one way only.
    pub reflects: Vec<bool>,
    pub steps: Vec<(u64, Step)>,
    /// How many messages of each topic were overwritten before a callback took them.
    pub lost: BTreeMap<(usize, usize), u64>,
    /// Of each topic that a join waits for: how many it dropped and refused.
    pub unused: Vec<Vec<[u64; 2]>>,
}

impl Seen {
    pub fn new(model: &Model) -> Seen {
        let (callbacks, chains) = (model.callbacks.len(), model.chains.len());
        let is_direct = |path: &Vec<usize>| path.windows(2).all(|pair| triggers(model, pair[0], pair[1]));
        let reflects = |path: &Vec<usize>| path.windows(2).all(|pair| is_only_way(model, pair[0], pair[1]));
        Seen {
            responses: vec![0; callbacks],
            queues: vec![0; callbacks],
            queues_without_stall: vec![0; callbacks],
            latencies: vec![0; chains],
            ages: vec![0; chains],
            reactions: vec![0; chains],
            waits: model.callbacks.iter().map(|callback| vec![0; callback.triggers.len()]).collect(),
            held: vec![0; callbacks],
            steps: Vec::new(),
            lost: BTreeMap::new(),
            unused: vec![Vec::new(); callbacks],
            reflects: model.chains.iter().map(reflects).collect(),
            is_direct: model.chains.iter().map(is_direct).collect(),
        }
    }

    pub fn take(&mut self, other: &Seen) {
        let longest = |mine: &mut Vec<u64>, its: &Vec<u64>| {
            mine.iter_mut().zip(its).for_each(|(mine, its)| *mine = (*its).max(*mine))
        };
        longest(&mut self.responses, &other.responses);
        longest(&mut self.latencies, &other.latencies);
        longest(&mut self.ages, &other.ages);
        longest(&mut self.reactions, &other.reactions);
        self.waits.iter_mut().zip(&other.waits).for_each(|(mine, its)| longest(mine, its));
        for (mine, its) in self.queues_without_stall.iter_mut().zip(&other.queues) {
            *mine = (*its).max(*mine);
        }
        self.stalled(other);
    }

    /// The same of a run with stalls, which only the queues outlast.
    pub fn stalled(&mut self, other: &Seen) {
        let most = |mine: &mut [usize], its: &[usize]| {
            mine.iter_mut().zip(its).for_each(|(mine, its)| *mine = (*its).max(*mine))
        };
        most(&mut self.queues, &other.queues);
        most(&mut self.held, &other.held);
    }
}

/// Whether what comes to a join by this step is all of one topic, of which nothing else comes.
fn is_only_way(model: &Model, from: usize, to: usize) -> bool {
    if model.callbacks[to].join.is_none() {
        return true;
    }
    let topics = model.callbacks[to].triggers.iter();
    let mut topics = topics.filter(|topic| model.publishers(**topic).any(|publisher| publisher == from));
    let alone = topics.next().is_some_and(|topic| model.publishers(*topic).count() == 1);
    alone && topics.next().is_none() && model.ways(from).len() == 1
}

fn triggers(model: &Model, from: usize, to: usize) -> bool {
    model.callbacks[to]
        .triggers
        .iter()
        .any(|topic| model.publishers(*topic).any(|publisher| publisher == from))
}

/// Which job of a chain's first stage something goes back to, and from when that one's response counts.
pub type Tag = Option<(usize, u64)>;

#[derive(Clone)]
pub struct Message {
    pub callback: usize,
    /// The topic, each of which has a queue of its own; of its own releases, the callback.
    pub topic: usize,
    /// From when its response counts: the nominal release, or the arrival.
    pub base: u64,
    /// Its place in a group's queue.
    order: u64,
    pub stamp: u64,
    /// By which callbacks and topics it came.
    pub way: u64,
    pub number: u64,
    /// Those of all that a join has waited for.
    pub set: Vec<u64>,
    /// Whether its group has taken it, to know whose turn it is.
    is_held: bool,
    pub tags: Vec<Tag>,
}

struct Job {
    message: Message,
    /// How much of its work its executor does before it has taken the message, and the priority to which its thread lowers itself then.
    executor: u64,
    lowered: Option<u8>,
    /// What a join takes besides.
    more: Vec<Message>,
    work: u64,
    done: u64,
    /// Its sections: of which lock, from when in its work, and how long.
    locks: Vec<(usize, u64, u64)>,
    /// What nothing preempts: from when in its work, and how long.
    section: (u64, u64),
    has_begun: bool,
    is_demoted: bool,
    used: u64,
}

struct Thread {
    core: usize,
    members: Vec<usize>,
    queue: Vec<Message>,
    job: Option<Job>,
    /// The lock that it waits for.
    blocked_on: Option<usize>,
    /// In the order of ranks, callbacks and topics of timers that were due and messages that were reported together, and are still to be taken.
    round: Vec<(usize, usize)>,
    /// The priority to which it has lowered itself, for the message that it took last.
    lowered: Option<u8>,
    is_over: bool,
    /// Jobs that arrived up to then run below all others, after one that was demoted.
    low_until: u64,
    asleep_until: u64,
    /// Of a suspended one: what is left of the budget, when the next begins, and whether the last job overran.
    left: u64,
    refill_at: u64,
    is_behind: bool,
}

impl Thread {
    fn has_work(&self) -> bool {
        self.job.is_some() || !self.queue.is_empty()
    }

    fn is_reserved(&self, model: &Model) -> bool {
        matches!(model.callbacks[self.members[0]].budget, Budget::Reserved(..))
    }
}

enum Event {
    Message(Message),
    /// The topic, the host, and what it says of each chain.
    Register(usize, usize, Vec<Tag>),
    Gateway(usize),
}

struct Machine<'m> {
    model: &'m Model,
    rng: StdRng,
    /// Whether jobs that are held to their budgets exceed them.
    is_wild: bool,
    now: u64,
    /// The instant at which jobs end: this one before anything has run in it, then the next.
    instant: u64,
    events: BTreeMap<u64, Vec<Event>>,
    threads: Vec<Thread>,
    thread_of: Vec<usize>,
    /// Of each core: work of the sampler and the gateway, with what the sampler then wakes.
    top: Vec<VecDeque<(u64, Option<Message>)>>,
    interrupts: Vec<u64>,
    /// Of each core: the thread that it switched to last, and what is left of the switch.
    running: Vec<Option<usize>>,
    switching: Vec<u64>,
    /// What real-time threads have used of this period of the throttling, and from when on each core stands still.
    used: Vec<u64>,
    stalled_from: Vec<u64>,
    /// Who holds each lock of each core.
    holder: Vec<[Option<usize>; 2]>,
    /// By callback, and of a join by topic.
    waiting: BTreeMap<(usize, usize), usize>,
    joins: Vec<Option<Waiting>>,
    /// Whether timers stamp by when a release was due, came, or its job ended.
    stamps: u8,
    registers: Vec<Vec<Vec<Tag>>>,
    silent_until: Vec<u64>,
    starts: Vec<Vec<u64>>,
    reflected: Vec<Option<usize>>,
    published: u64,
    overran: Vec<bool>,
    seen: Seen,
}

pub fn simulate(model: &Model, run: &Run) -> Seen {
    let mut rng = StdRng::seed_from_u64(run.seed);
    let Run { is_wild, stalls, .. } = *run;
    let is_late = run.silent_until.iter().any(|until| *until > 0);
    let (count, cores, chains) = (model.callbacks.len(), model.hosts.len(), model.chains.len());
    let mut threads: Vec<Thread> = Vec::new();
    let mut thread_of = Vec::new();
    for (i, Callback { core, group, .. }) in model.callbacks.iter().enumerate() {
        let same = |thread: &Thread| {
            thread.core == *core && group.is_some() && model.callbacks[thread.members[0]].group == *group
        };
        let at = threads.iter().position(same).unwrap_or_else(|| {
            threads.push(Thread {
                core: *core,
                members: Vec::new(),
                queue: Vec::new(),
                job: None,
                blocked_on: None,
                round: Vec::new(),
                lowered: None,
                is_over: false,
                low_until: 0,
                asleep_until: 0,
                left: 0,
                refill_at: 0,
                is_behind: false,
            });
            threads.len() - 1
        });
        threads[at].members.push(i);
        thread_of.push(at);
    }
    let (late, stamps) = (rng.random_bool(0.5), rng.random_range(0..3));
    let mut events: BTreeMap<u64, Vec<Event>> = BTreeMap::new();
    for (i, callback) in
        model.callbacks.iter().enumerate().filter(|(_, callback)| callback.triggers.is_empty())
    {
        let first = run.phases[i];
        let (mut nominal, mut last) = (first, 0);
        while nominal < run.until {
            // As late as it can come for a while, then early: bursts.
            let most = callback.jitter;
            let delay = if late && nominal < first + callback.period {
                most
            } else {
                [0, rng.random_range(0..=most)][rng.random_range(0..2)]
            };
            let earliest = if last > 0 { last + callback.min_distance } else { 0 };
            last = earliest.max(nominal + delay);
            let order = if callback.is_outside { last } else { nominal };
            let stamp = if stamps == 1 { last } else { nominal };
            let tags = vec![None; chains];
            let message = Message {
                callback: i,
                topic: i,
                base: nominal,
                order,
                stamp,
                way: i as u64,
                number: nominal,
                set: Vec::new(),
                is_held: false,
                tags,
            };
            events.entry(last).or_default().push(Event::Message(message));
            nominal += callback.period;
        }
    }
    // Each core stands still once, in half of the runs right after the one before.
    let (mut next, in_turn) = (rng.random_range(0..run.until / 2), rng.random_bool(0.5));
    let stall = |_| {
        let from = if in_turn { next } else { rng.random_range(0..run.until / 2) };
        next = from + model.stall;
        if stalls { from } else { u64::MAX }
    };
    let stalled_from = (0..cores).map(stall).collect();
    let hosts = model.hosts.iter().max().map_or(1, |last| last + 1);
    let mut machine = Machine {
        model,
        is_wild,
        now: 0,
        instant: 0,
        events,
        threads,
        thread_of,
        top: (0..cores).map(|_| VecDeque::new()).collect(),
        interrupts: vec![0; cores],
        running: vec![None; cores],
        switching: vec![0; cores],
        used: vec![0; cores],
        stalled_from,
        holder: vec![[None; 2]; cores],
        waiting: BTreeMap::new(),
        joins: (0..count)
            .map(|i| {
                let size = run.queue_sizes.get(i).copied().filter(|_| is_wild || is_late).unwrap_or(ENDLESS);
                Waiting::new(model, i, size)
            })
            .collect(),
        stamps,
        registers: vec![vec![vec![None; chains]; hosts]; count],
        silent_until: run.silent_until.clone(),
        starts: vec![Vec::new(); chains],
        reflected: vec![None; chains],
        published: 0,
        overran: vec![false; count],
        seen: Seen::new(model),
        rng,
    };
    let tick_from = machine.rng.random_range(0..50);
    while machine.now < run.until {
        machine.step(tick_from);
    }
    for (chain, path) in model.chains.iter().enumerate() {
        // What was never reflected, as far as there was time to.
        let last = machine.reflected[chain].unwrap_or(0);
        let since = machine.since(path);
        let missed =
            machine.starts[chain].iter().skip(last).find(|start| since.is_some_and(|since| **start >= since));
        if let Some(start) = missed.filter(|_| is_timer(model, path[0])) {
            machine.seen.reactions[chain] = machine.seen.reactions[chain].max(run.until - start);
        }
    }
    let Machine { mut seen, overran, joins, .. } = machine;
    for (i, join) in joins.into_iter().enumerate() {
        if let Some(join) = join {
            (seen.waits[i], seen.held[i], seen.unused[i]) = (join.waits, join.most, join.unused);
        }
    }
    // What exceeds its budget may be as late as it likes, and so may chains through it, and what waits for it.
    let late = |i: usize| model.upstream(i).iter().any(|i| overran[*i]);
    for (i, overran) in overran.iter().enumerate() {
        if *overran {
            (seen.responses[i], seen.queues[i]) = (0, 0);
        }
        if model.callbacks[i].join.is_some() && late(i) {
            seen.waits[i].fill(0);
            seen.held[i] = 0;
        }
        // What waits for the first message of one that starts late is in no bound.
        if is_late {
            seen.held[i] = 0;
        }
    }
    for (i, path) in model.chains.iter().enumerate() {
        let waits = |stage: &usize| model.callbacks[*stage].join.is_some() && late(*stage);
        if path.iter().any(|stage| overran[*stage] || waits(stage)) {
            (seen.latencies[i], seen.ages[i], seen.reactions[i]) = (0, 0, 0);
        }
    }
    seen
}

fn is_timer(model: &Model, i: usize) -> bool {
    model.callbacks[i].triggers.is_empty() && !model.callbacks[i].is_outside
}

impl Machine<'_> {
    fn step(&mut self, tick_from: u64) {
        let is_due = |(period, _): &(u64, u64), at: u64| self.now % period == at % period;
        let (tick, refill) = (
            self.model.tick.filter(|tick| is_due(tick, tick_from)),
            self.model.throttling.filter(|throttling| is_due(throttling, tick_from * 7)),
        );
        let cores = (0..self.model.hosts.len()).filter(|core| !self.is_stalled(*core)).collect::<Vec<_>>();
        self.used
            .iter_mut()
            .for_each(|used| *used = used.saturating_sub(refill.map_or(0, |(_, runtime)| runtime)));
        self.instant = self.now;
        for core in &cores {
            while self.finish(*core) {}
        }
        self.interrupts.iter_mut().for_each(|left| *left += tick.map_or(0, |(_, wcet)| wcet));
        self.arrive();
        self.instant = self.now + 1;
        for core in cores {
            self.run(core);
        }
        self.now += 1;
    }

    fn is_stalled(&self, core: usize) -> bool {
        let from = self.stalled_from[core];
        (from..from.saturating_add(self.model.stall)).contains(&self.now)
    }

    /// Everything that is due now.
    fn arrive(&mut self) {
        for event in self.events.remove(&self.now).unwrap_or_default() {
            match event {
                Event::Register(topic, host, tags) => self.registers[topic][host] = tags,
                Event::Gateway(core) => {
                    self.top[core].push_back((self.model.gateway[self.model.hosts[core]], None));
                }
                Event::Message(message) => {
                    let Message { callback, topic, number, stamp, .. } = message;
                    self.record(Step::Arrived { callback, topic, number, stamp });
                    let i = message.callback;
                    let waiting = self.waiting(&message);
                    *waiting += 1;
                    let waiting = *waiting;
                    self.seen.queues[i] = self.seen.queues[i].max(waiting);
                    if let Some(join) = &mut self.joins[i] {
                        join.came(&message);
                    }
                    match self.per_message(i) {
                        0 => self.wake(message),
                        cost => self.top[self.model.callbacks[i].core].push_back((cost, Some(message))),
                    }
                }
            }
        }
    }

    fn record(&mut self, step: Step) {
        self.seen.steps.push((self.now, step));
    }

    fn waiting(&mut self, of: &Message) -> &mut usize {
        let topic = if self.model.callbacks[of.callback].join.is_some() { of.topic } else { 0 };
        self.waiting.entry((of.callback, topic)).or_default()
    }

    fn per_message(&self, callback: usize) -> u64 {
        self.model.per_message[self.model.hosts[self.model.callbacks[callback].core]]
    }

    /// From when all that the joins of a chain wait for has come, and all before its stages publish.
    fn since(&self, path: &[usize]) -> Option<u64> {
        let before = path.iter().flat_map(|stage| self.model.upstream(*stage));
        let all_publish = before.map(|i| self.silent_until[i]).max().unwrap_or(0);
        let mut joins = path.iter().filter_map(|stage| self.joins[*stage].as_ref());
        joins.try_fold(all_publish, |latest: u64, join| Some(latest.max(join.since?)))
    }

    /// The sampler hands a message to its thread; a timer keeps only its newest release.
    fn wake(&mut self, message: Message) {
        let callback = &self.model.callbacks[message.callback];
        let (i, at) = (message.callback, self.thread_of[message.callback]);
        if self.model.floats
            && matches!(callback.budget, Budget::Reserved(..))
            && !self.threads[at].has_work()
        {
            // Any core that no other reservation has.
            let others =
                self.threads.iter().filter(|other| other.is_reserved(self.model) && other.has_work());
            let taken: Vec<usize> = others.map(|other| other.core).collect();
            let free: Vec<usize> = (0..self.model.hosts.len()).filter(|core| !taken.contains(core)).collect();
            self.threads[at].core = free[self.rng.random_range(0..free.len())];
        }
        let thread = &mut self.threads[at];
        if let Budget::Reserved(runtime, period) = callback.budget
            && !thread.has_work()
        {
            // The server's rule for a thread that is woken.
            let rest = thread.refill_at.saturating_sub(self.now);
            if rest == 0 || thread.left * period > rest * runtime {
                (thread.left, thread.refill_at) = (runtime, self.now + period);
            }
        }
        if thread.is_over {
            return *self.waiting(&message) -= 1;
        }
        let queue = &mut thread.queue;
        let most = if is_timer(self.model, i) { 1 } else { callback.depth };
        let topic = message.topic;
        let is_alike = |other: &Message| {
            other.set.is_empty() && !other.is_held && (other.callback, other.topic) == (i, topic)
        };
        let mut lost = 0;
        while queue.iter().filter(|other| is_alike(other)).count() >= most {
            let oldest = queue.iter().position(is_alike).unwrap_or(0);
            queue.remove(oldest);
            lost += 1;
        }
        queue.push(message.clone());
        *self.waiting(&message) -= lost;
        *self.seen.lost.entry((i, topic)).or_default() += lost as u64;
    }

    fn is_throttled(&self, core: usize) -> bool {
        self.model.throttling.is_some_and(|(_, runtime)| self.used[core] >= runtime)
    }

    /// The thread whose job nothing preempts now.
    fn stiff(&self, core: usize) -> Option<usize> {
        self.threads.iter().position(|thread| {
            thread.core == core
                && thread.job.as_ref().is_some_and(|job| {
                    let (from, length) = job.section;
                    (from + 1..from + length).contains(&job.done)
                })
        })
    }

    /// The thread that runs next.
    fn best(&self, core: usize) -> Option<usize> {
        // Of equals the one that runs goes on, and what a lock has made equal was there before.
        let goes_on = |at: usize| self.running[core] == Some(at) || self.holder[core].contains(&Some(at));
        let ready = (0..self.threads.len()).filter(|at| self.is_ready(core, *at));
        ready.max_by_key(|at| (self.rank(*at), goes_on(*at)))
    }

    /// Ends the job whose work is done and whose turn it is to return, if there is one.
    fn finish(&mut self, core: usize) -> bool {
        let is_busy = self.interrupts[core] > 0 || self.switching[core] > 0 || self.stiff(core).is_some();
        let Some(at) = self.best(core).filter(|_| !is_busy && !self.is_throttled(core)) else { return false };
        let is_here = self.running[core] == Some(at) || self.model.switch == 0;
        let is_next = self.rank(at) == 100 || self.top[core].is_empty();
        match self.threads[at].job.take_if(|job| is_here && is_next && job.done == job.work) {
            Some(job) => self.end(at, &job),
            None => return false,
        }
        true
    }

    fn run(&mut self, core: usize) {
        if self.interrupts[core] > 0 {
            self.interrupts[core] -= 1;
            return;
        }
        if self.is_throttled(core) {
            return;
        }
        if self.switching[core] > 0 {
            self.switching[core] -= 1;
            self.used[core] += 1;
            return;
        }
        if let Some(at) = self.stiff(core) {
            self.work(at);
            return;
        }
        loop {
            let best = self.best(core);
            let reserved = best.is_some_and(|at| self.rank(at) == 100);
            if !reserved && let Some((left, _)) = self.top[core].front_mut() {
                *left -= 1;
                self.used[core] += 1;
                if *left == 0
                    && let Some((_, Some(message))) = self.top[core].pop_front()
                {
                    self.wake(message);
                }
                return;
            }
            let Some(at) = best else {
                self.switch(core, None);
                return;
            };
            if self.threads[at].job.is_none() {
                self.begin(at);
                // It may be demoted from the start.
                continue;
            }
            let is_done = self.threads[at].job.as_ref().is_some_and(|job| job.done == job.work);
            if (is_done || !self.is_used_up(at)) && self.switch(core, Some(at)) {
                return;
            }
            if is_done {
                // Whoever was before it is demoted or asleep just now.
                self.instant = self.now;
                self.finish(core);
                self.arrive();
                self.instant = self.now + 1;
                continue;
            }
            if self.may_go_on(core, at) {
                self.work(at);
                return;
            }
        }
    }

    /// Whether this step is spent on the switch to a thread, or to none: the first switch to a job is the job's own, others are part of what
    /// preempted it.
    fn switch(&mut self, core: usize, to: Option<usize>) -> bool {
        let cost = self.model.switch;
        let from = std::mem::replace(&mut self.running[core], to);
        if cost == 0 || from == to {
            return false;
        }
        self.switching[core] = cost - 1;
        self.used[core] += 1;
        let budget =
            to.and_then(|at| self.threads[at].job.as_ref()).map(|job| self.budget(job.message.callback));
        if let Some(thread) = to.map(|at| &mut self.threads[at]) {
            let is_new = thread.job.as_ref().is_some_and(|job| job.used == 0) || Some(thread.left) == budget;
            if is_new {
                thread.left = thread.left.saturating_sub(cost);
                thread.job.iter_mut().for_each(|job| job.used += cost);
            }
        }
        true
    }

    /// What a job may use before it is held.
    fn budget(&self, callback: usize) -> u64 {
        let Callback { charged, wcet, .. } = self.model.callbacks[callback];
        charged.max(wcet)
    }

    fn is_used_up(&self, at: usize) -> bool {
        let thread = &self.threads[at];
        thread.job.as_ref().is_some_and(|job| match self.model.callbacks[job.message.callback].budget {
            Budget::Tell => false,
            Budget::Demote | Budget::End => !job.is_demoted && job.used >= self.budget(job.message.callback),
            Budget::Suspend | Budget::Reserved(..) => thread.left == 0,
        })
    }

    fn is_ready(&self, core: usize, at: usize) -> bool {
        let thread = &self.threads[at];
        thread.core == core
            && thread.blocked_on.is_none()
            && thread.asleep_until <= self.now
            && (thread.job.is_some() || !thread.queue.is_empty())
    }

    /// The priority at which a thread runs now: between jobs its own, so that the next one is taken at once and waits below all others as a job
    /// (ADR 10), not in the queue.
    fn rank(&self, at: usize) -> u8 {
        let thread = &self.threads[at];
        let callback = &self.model.callbacks[thread.members[0]];
        let own = match (&thread.job, callback.budget) {
            (_, Budget::Reserved(..)) => return 100,
            (Some(job), _) if job.is_demoted => 0,
            _ => self.priority(at),
        };
        let Some(lock) = self.holder[thread.core].iter().position(|holder| *holder == Some(at)) else {
            return own;
        };
        let users = (0..self.threads.len()).filter(|other| self.threads[*other].core == thread.core);
        let locks = |i: &usize| self.model.callbacks[*i].locks.iter().any(|(other, _)| *other == lock);
        let users = users.filter(|other| match self.model.is_ceiling {
            true => self.threads[*other].members.iter().any(locks),
            false => self.threads[*other].blocked_on == Some(lock),
        });
        // A lock's ceiling is that of all who use it; who waits for a lock has the priority of its job.
        let of = |other: usize| match self.model.is_ceiling {
            true => {
                let users = self.threads[other].members.iter().filter(|i| locks(i));
                users.map(|i| self.priority_of(*i)).max().unwrap_or(0)
            }
            false => self.priority(other),
        };
        users.map(of).max().unwrap_or(0).max(own)
    }

    fn priority(&self, at: usize) -> u8 {
        let Thread { members, lowered, job, queue, round, .. } = &self.threads[at];
        let own = self.ceiling_of(members[0]);
        // From one job to the next it takes a message or waits, before which it returns to its ceiling; but not for a set, which what it took last
        // completes, or for a timer in the same round.
        let stays = job.is_some()
            || queue.first().is_some_and(|message| !message.set.is_empty())
            || round.first().is_some_and(|(i, _)| is_timer(self.model, *i));
        lowered.filter(|_| stays).unwrap_or(own)
    }

    /// The highest priority at which a callback runs.
    fn priority_of(&self, i: usize) -> u8 {
        let callback = &self.model.callbacks[i];
        let is_lowered = callback.group.is_some_and(|group| self.model.ceiling(group).is_some());
        if is_lowered && !is_timer(self.model, i) { callback.priority } else { self.ceiling_of(i) }
    }

    /// The priority of a callback's thread while it waits.
    fn ceiling_of(&self, i: usize) -> u8 {
        let callback = &self.model.callbacks[i];
        match callback.group {
            Some(group) if self.model.groups[group].has_ranks() => {
                self.model.ceiling(group).unwrap_or(group_priority(group))
            }
            _ => callback.priority,
        }
    }

    fn begin(&mut self, at: usize) {
        let next = self.next(at);
        let thread = &mut self.threads[at];
        let mut message = thread.queue.remove(next);
        let i = message.callback;
        let callback = &self.model.callbacks[i];
        let mut more = Vec::new();
        // An executor of ROS 2 takes one message in a run.
        let drains = self.model.executors[callback.core].is_none();
        if matches!(callback.join, Some((Matching::Newest, _))) && message.set.is_empty() && drains {
            more = thread.queue.extract_if(.., |other| other.callback == i).collect();
        }
        let takes = callback.join.filter(|_| message.set.is_empty()).map(|(_, take)| take);
        let may_overrun = self.is_wild && callback.budget != Budget::Tell && self.rng.random_bool(0.4);
        let takes = takes.map(|take| take * (1 + more.len() as u64));
        let most = if may_overrun { callback.wcet * 3 + 2 } else { takes.unwrap_or(callback.wcet) };
        let work = match self.rng.random_bool(0.7) {
            true => most,
            false => self.rng.random_range(callback.bcet.clamp(1, most)..=most),
        };
        self.overran[i] |= work > callback.wcet && takes.is_none();
        // The executor comes first, which others preempt; a set is passed on in the run that takes its last message.
        let executor = self.model.executors[callback.core].filter(|_| message.set.is_empty()).unwrap_or(0);
        let is_held = callback.budget.demotes() || callback.budget == Budget::Suspend;
        let executor = executor * (1 + more.len() as u64) + if is_held { self.model.demotion } else { 0 };
        let length = callback.non_preemptive.min(work);
        let section = (executor + self.rng.random_range(0..=work - length), length);
        let mut locks = Vec::new();
        let mut free = work.saturating_sub(callback.locks.iter().map(|(_, length)| length).sum());
        let mut from = executor;
        for (lock, length) in callback.locks.iter().filter(|_| takes.is_none()) {
            if from + free + length <= executor + work {
                let before = self.rng.random_range(0..=free);
                locks.push((*lock, from + before, *length));
                (from, free) = (from + before + length, free - before);
            }
        }
        let work = work + executor;
        for (chain, path) in self.model.chains.iter().enumerate().filter(|_| takes.is_none()) {
            let Some(stage) = path.iter().position(|stage| *stage == i) else { continue };
            if stage == 0 {
                self.starts[chain].push(self.now);
                message.tags[chain] = Some((self.starts[chain].len() - 1, message.base));
            } else if !triggers(self.model, path[stage - 1], i) {
                message.tags[chain] = self.registers[path[stage - 1]][self.model.hosts[callback.core]][chain];
            }
        }
        let budget = self.budget(i);
        let thread = &mut self.threads[at];
        if callback.budget == Budget::Suspend {
            thread.is_behind &= message.order < thread.refill_at;
            if !thread.is_behind {
                let period = self.model.period(i);
                (thread.left, thread.refill_at) =
                    (budget, message.order.max(self.now.saturating_sub(period)) + period);
            }
        }
        let is_demoted =
            callback.budget.demotes() && message.order <= thread.low_until && thread.low_until > 0;
        // A message is taken at the ceiling, after which its callback runs at its own priority; sets, and timers after it, keep that.
        let is_taken = message.set.is_empty() && !is_timer(self.model, i);
        let group = callback.group.filter(|group| self.model.ceiling(*group).is_some());
        let lowered = group.filter(|_| is_taken).map(|_| callback.priority);
        if is_taken {
            thread.lowered = lowered.filter(|_| executor == 0);
        }
        let (done, used, has_begun) = (0, 0, false);
        thread.job = Some(Job {
            message,
            executor,
            lowered,
            more,
            work,
            done,
            locks,
            section,
            has_begun,
            is_demoted,
            used,
        });
    }

    /// What a thread takes next from its queue: its own topics one after the other, those of several in any order; a set before more of what made it.
    fn next(&mut self, at: usize) -> usize {
        let model = self.model;
        let thread = &mut self.threads[at];
        let group = model.callbacks[thread.queue[0].callback].group;
        if group.is_some_and(|group| model.groups[group] == Order::Fifo) {
            for member in thread.members.iter().filter(|i| model.callbacks[**i].join.is_none()) {
                let first = thread.queue.iter_mut().find(|message| message.callback == *member);
                first.into_iter().for_each(|message| message.is_held = true);
            }
        }
        let queue = &thread.queue;
        let callback = match group.map(|group| model.groups[group]) {
            Some(Order::Fifo) if !thread.members.iter().any(|i| model.callbacks[*i].join.is_some()) => {
                return (0..queue.len()).min_by_key(|m| queue[*m].order).unwrap_or(0);
            }
            // A set is passed on by what takes its last message.
            Some(Order::Rank | Order::Lowered) if !queue[0].set.is_empty() => return 0,
            // An executor of ROS 2 runs the timers that were due at its wait, and takes one message of each subscription that was reported, in the
            // order of their creation. That of rclpy does so for one node after the other.
            Some(Order::Rank | Order::Lowered) => {
                let of = |message: &Message| (message.callback, message.topic);
                thread.round.retain(|one| queue.iter().any(|message| of(message) == *one));
                if thread.round.is_empty() {
                    thread.lowered = None;
                    let rank = |message: &Message| model.callbacks[message.callback].priority;
                    let is_due = |message: &&Message| is_timer(model, message.callback);
                    let (due, ready): (Vec<&Message>, Vec<&Message>) = queue.iter().partition(is_due);
                    let highest = ready.iter().map(|message| rank(message)).max();
                    let reported = ready.into_iter().filter(|message| Some(rank(message)) == highest);
                    thread.round = due.into_iter().map(of).collect();
                    thread.round.shuffle(&mut self.rng);
                    thread.round.extend(BTreeSet::from_iter(reported.map(of)));
                    thread.round.sort_by_key(|(i, _)| (model.is_of_second_node(*i), !is_timer(model, *i)));
                }
                let next = thread.round.remove(0);
                return first(queue, &mut self.rng, |message| of(message) == next);
            }
            _ => queue[self.rng.random_range(0..queue.len())].callback,
        };
        let of: Vec<usize> = (0..queue.len()).filter(|m| queue[*m].callback == callback).collect();
        if let Some(set) = of.iter().find(|m| !queue[**m].set.is_empty()) {
            return *set;
        }
        let topic = match &self.joins[callback] {
            Some(join) => join.turn(|topic| of.iter().any(|m| queue[*m].topic == topic)),
            None => queue[of[self.rng.random_range(0..of.len())]].topic,
        };
        first(queue, &mut self.rng, |message| (message.callback, message.topic) == (callback, topic))
    }

    /// Whether a job has a budget and its lock; otherwise it is demoted, sleeps or waits.
    fn may_go_on(&mut self, core: usize, at: usize) -> bool {
        let Some(i) = self.threads[at].job.as_ref().map(|job| job.message.callback) else { return false };
        let (budget, is_used_up) = (self.budget(i), self.is_used_up(at));
        let thread = &mut self.threads[at];
        let Some(job) = &mut thread.job else { return false };
        match self.model.callbacks[i].budget {
            Budget::Demote | Budget::End if is_used_up => {
                job.is_demoted = true;
                self.record(Step::Demoted { callback: i });
                return false;
            }
            Budget::Suspend | Budget::Reserved(..) if is_used_up => {
                let (more, period) = match self.model.callbacks[i].budget {
                    Budget::Reserved(runtime, period) => (runtime, period),
                    _ => (budget, self.model.period(i)),
                };
                thread.is_behind = true;
                thread.asleep_until = thread.refill_at;
                thread.left = more;
                thread.refill_at += period;
                if matches!(self.model.callbacks[i].budget, Budget::Reserved(..))
                    && thread.refill_at < self.now
                {
                    // More than a period behind, the server begins anew.
                    thread.refill_at = self.now + period;
                }
                let until = thread.asleep_until;
                if until > self.now {
                    self.record(Step::Suspended { callback: i, until });
                }
                return until <= self.now;
            }
            _ => {}
        }
        let taken = job.locks.iter().find(|(_, offset, _)| *offset == job.done);
        let taken = taken.map(|(lock, ..)| *lock).filter(|lock| self.holder[core][*lock] != Some(at));
        let Message { number, set, .. } = &job.message;
        if !std::mem::replace(&mut job.has_begun, true) && (self.joins[i].is_none() || !set.is_empty()) {
            let numbers = if set.is_empty() { vec![*number] } else { set.clone() };
            self.seen.steps.push((self.now, Step::Begun { callback: i, numbers }));
        }
        let Some(lock) = taken else { return true };
        if self.holder[core][lock].is_some() {
            let is_demoted = job.is_demoted;
            self.threads[at].blocked_on = Some(lock);
            self.record(Step::Blocked { callback: i, lock, is_demoted });
            return false;
        }
        self.holder[core][lock] = Some(at);
        self.record(Step::Locked { callback: i, lock });
        true
    }

    fn work(&mut self, at: usize) {
        let thread = &mut self.threads[at];
        thread.left = thread.left.saturating_sub(1);
        let core = thread.core;
        let Some(job) = &mut thread.job else { return };
        self.used[core] += u64::from(!job.is_demoted);
        job.done += 1;
        job.used += 1;
        thread.lowered = job.lowered.filter(|_| job.done >= job.executor).or(thread.lowered);
        let released = job.locks.iter().find(|(_, offset, length)| job.done == offset + length);
        // A lock or a section that ends with the work is given back before the job returns: who waited for that goes first, unless the section
        // is the whole run.
        let (from, length) = job.section;
        let callback = &self.model.callbacks[job.message.callback];
        let is_part = (1..callback.wcet).contains(&callback.non_preemptive);
        let gives_back = released.is_some() || is_part && job.done == from + length;
        let (is_done, callback) = (job.done == job.work && !gives_back, job.message.callback);
        if let Some(lock) = released.map(|(lock, ..)| *lock) {
            self.holder[core][lock] = None;
            self.seen.steps.push((self.now + 1, Step::Unlocked { callback, lock }));
            let waits = |other: &&mut Thread| other.core == core && other.blocked_on == Some(lock);
            self.threads.iter_mut().filter(waits).for_each(|other| other.blocked_on = None);
        }
        if is_done && let Some(job) = self.threads[at].job.take() {
            self.end(at, &job);
        }
    }

    fn end(&mut self, at: usize, job: &Job) {
        let (i, now) = (job.message.callback, self.instant);
        if job.message.set.is_empty() {
            job.more.iter().chain([&job.message]).for_each(|message| *self.waiting(message) -= 1);
        }
        if job.is_demoted {
            self.threads[at].low_until = now;
            if self.model.callbacks[i].budget == Budget::End {
                self.threads[at].is_over = true;
                let queued = std::mem::take(&mut self.threads[at].queue);
                queued.iter().for_each(|message| *self.waiting(message) -= 1);
            }
        }
        self.seen.responses[i] = self.seen.responses[i].max(now - job.message.base);
        if self.joins[i].is_some() && job.message.set.is_empty() {
            for message in [&job.message].into_iter().chain(&job.more) {
                self.seen.steps.push((now, Step::Taken { callback: i, topic: message.topic }));
            }
        } else {
            self.seen.steps.push((now, Step::Ended { callback: i }));
        }
        if let Some(join) = self.joins[i].as_mut().filter(|_| job.message.set.is_empty()) {
            let sets = join.take(self.model, &job.message, &job.more, now);
            let set = |set: super::waiting::Set| Message {
                topic: i,
                base: set.activation,
                order: set.activation,
                stamp: set.stamp,
                way: i as u64,
                number: 0,
                set: set.numbers,
                is_held: false,
                tags: set.tags,
                callback: i,
            };
            let queue = &mut self.threads[at].queue;
            queue.splice(0..0, sets.into_iter().map(set));
            return;
        }
        let mut tags = job.message.tags.clone();
        for (chain, path) in self.model.chains.iter().enumerate() {
            if !path.contains(&i) {
                tags[chain] = None;
            }
            let Some((source, base)) = tags[chain].filter(|_| path.last() == Some(&i)) else { continue };
            let Some(since) = self.since(path) else { continue };
            if base < since {
                self.reflected[chain] = self.reflected[chain].max(Some(source));
                continue;
            }
            self.seen.latencies[chain] = self.seen.latencies[chain].max(now - base);
            self.seen.ages[chain] = self.seen.ages[chain].max(now - base);
            if is_timer(self.model, path[0]) {
                // Events just after the start of the job before are reflected for the first time.
                for event in self.reflected[chain].map_or(source, |last| last + 1)..=source {
                    if let Some(missed) =
                        event.checked_sub(1).filter(|missed| self.starts[chain][*missed] >= since)
                    {
                        self.seen.reactions[chain] =
                            self.seen.reactions[chain].max(now - self.starts[chain][missed]);
                    }
                }
            }
            self.reflected[chain] = self.reflected[chain].max(Some(source));
        }
        if now < self.silent_until[i] {
            return;
        }
        let stamps_now = self.stamps == 2 && self.model.callbacks[i].triggers.is_empty();
        let stamp = if stamps_now { now } else { job.message.stamp };
        self.published += 1;
        let number = self.published;
        let (set, is_held) = (Vec::new(), false);
        self.publish(&Message { stamp, tags, number, set, is_held, ..job.message.clone() }, now);
    }

    fn at(&mut self, at: u64, event: Event) {
        self.events.entry(at.max(self.instant)).or_default().push(event);
    }

    fn publish(&mut self, message: &Message, now: u64) {
        let Message { callback: from, tags, stamp, way, .. } = message;
        let (from, stamp) = (*from, *stamp);
        let Callback { core, also, .. } = self.model.callbacks[from];
        let host = self.model.hosts[core];
        for topic in [Some(from), also].into_iter().flatten() {
            if self.model.gateway[host] > 0 {
                self.at(now, Event::Gateway(core));
            }
            for other in 0..=self.model.hosts.iter().copied().max().unwrap_or(0) {
                let (least, most) = self.model.network;
                // Each of two gateways may stand still.
                let stalls = if self.stalled_from[core] < u64::MAX { self.model.stall * 2 } else { 0 };
                let network = self.rng.random_range(least..=most + stalls);
                let at = if other == host { now } else { now + network };
                self.at(at, Event::Register(topic, other, tags.clone()));
                let mut served = Vec::new();
                let model = self.model;
                for (i, to) in model.callbacks.iter().enumerate() {
                    let is_taker = to.triggers.contains(&topic);
                    if self.model.hosts[to.core] != other || !(is_taker || to.reads == Some(topic)) {
                        continue;
                    }
                    if other != host && self.model.gateway[other] > 0 && !served.contains(&to.core) {
                        served.push(to.core);
                        self.at(at, Event::Gateway(to.core));
                    }
                    if is_taker {
                        let mut tags = tags.clone();
                        for (chain, path) in self.model.chains.iter().enumerate() {
                            let follows = path.windows(2).any(|pair| pair == [from, i]);
                            tags[chain] = tags[chain].filter(|_| follows);
                        }
                        let way = longer(*way, from, topic);
                        let message = Message {
                            callback: i,
                            topic,
                            base: at,
                            order: at,
                            stamp,
                            way,
                            tags,
                            ..message.clone()
                        };
                        self.at(at, Event::Message(message));
                    }
                }
            }
        }
    }
}

/// Of such messages one that is the first of its publisher: a subscription takes from one publisher after the other.
fn first(queue: &[Message], rng: &mut StdRng, is_such: impl Fn(&Message) -> bool) -> usize {
    let mut firsts = BTreeMap::new();
    for (at, message) in queue.iter().enumerate().filter(|(_, message)| is_such(message)) {
        firsts.entry(message.way).or_insert(at);
    }
    let firsts: Vec<usize> = firsts.into_values().collect();
    if firsts.is_empty() { 0 } else { firsts[rng.random_range(0..firsts.len())] }
}
