// SPDX-License-Identifier: MIT OR Apache-2.0
//! The cores, step by step.

use std::collections::{BTreeMap, VecDeque};

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use super::made_up::{Budget, Callback, DEPTH, Model};

const UNTIL: u64 = 1_500;

/// The worst of what was seen, in steps.
pub struct Seen {
    pub responses: Vec<u64>,
    pub queues: Vec<usize>,
    pub latencies: Vec<u64>,
    pub ages: Vec<u64>,
    pub reactions: Vec<u64>,
    /// Whether each stage of a chain triggers the next.
    pub is_direct: Vec<bool>,
}

impl Seen {
    pub fn new(model: &Model) -> Seen {
        let (callbacks, chains) = (model.callbacks.len(), model.chains.len());
        let is_direct = |path: &Vec<usize>| path.windows(2).all(|pair| triggers(model, pair[0], pair[1]));
        Seen {
            responses: vec![0; callbacks],
            queues: vec![0; callbacks],
            latencies: vec![0; chains],
            ages: vec![0; chains],
            reactions: vec![0; chains],
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
        self.queues.iter_mut().zip(&other.queues).for_each(|(mine, its)| *mine = (*its).max(*mine));
    }
}

fn triggers(model: &Model, from: usize, to: usize) -> bool {
    model.callbacks[to]
        .triggers
        .iter()
        .any(|topic| model.publishers(*topic).any(|publisher| publisher == from))
}

/// Which job of a chain's first stage something goes back to, and from when that one's response counts.
type Tag = Option<(usize, u64)>;

#[derive(Clone)]
struct Message {
    callback: usize,
    /// The topic, each of which has a queue of its own; of its own releases, the callback.
    topic: usize,
    /// From when its response counts: the nominal release, or the arrival.
    base: u64,
    /// Its place in a group's queue.
    order: u64,
    tags: Vec<Tag>,
}

struct Job {
    message: Message,
    work: u64,
    done: u64,
    lock: Option<(u64, u64)>,
    is_demoted: bool,
    used: u64,
}

struct Thread {
    core: usize,
    members: Vec<usize>,
    queue: Vec<Message>,
    job: Option<Job>,
    is_blocked: bool,
    /// Jobs that arrived up to then run below all others, after one that was demoted.
    low_until: u64,
    asleep_until: u64,
    /// Of a suspended one: what is left of the budget, when the next begins, and whether the last job overran.
    left: u64,
    refill_at: u64,
    is_behind: bool,
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
    events: BTreeMap<u64, Vec<Event>>,
    threads: Vec<Thread>,
    thread_of: Vec<usize>,
    /// Of each core: work of the sampler and the gateway, with what the sampler then wakes.
    top: Vec<VecDeque<(u64, Option<Message>)>>,
    interrupts: Vec<u64>,
    holder: Vec<Option<usize>>,
    waiting: Vec<usize>,
    registers: Vec<Vec<Vec<Tag>>>,
    starts: Vec<Vec<u64>>,
    reflected: Vec<Option<usize>>,
    overran: Vec<bool>,
    seen: Seen,
}

/// One run: with other phases, delays and execution times for each seed.
pub fn simulate(model: &Model, seed: u64, is_wild: bool) -> Seen {
    let mut rng = StdRng::seed_from_u64(seed);
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
                is_blocked: false,
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
    // Together at first, or anywhere.
    let (together, late) = (rng.random_range(0..200), rng.random_bool(0.5));
    let mut events: BTreeMap<u64, Vec<Event>> = BTreeMap::new();
    for (i, callback) in
        model.callbacks.iter().enumerate().filter(|(_, callback)| callback.triggers.is_empty())
    {
        let mut nominal = if rng.random_bool(0.6) { together } else { rng.random_range(0..callback.period) };
        nominal %= callback.period;
        let mut last = 0;
        while nominal < UNTIL {
            // As late as it can come for a while, then early: bursts.
            let most = callback.jitter;
            let delay = if late && nominal < together + callback.period {
                most
            } else {
                [0, rng.random_range(0..=most)][rng.random_range(0..2)]
            };
            last = last.max(nominal + delay);
            let order = if callback.is_outside { last } else { nominal };
            let message = Message { callback: i, topic: i, base: nominal, order, tags: vec![None; chains] };
            events.entry(last).or_default().push(Event::Message(message));
            nominal += callback.period;
        }
    }
    let hosts = model.hosts.iter().max().map_or(1, |last| last + 1);
    let mut machine = Machine {
        model,
        is_wild,
        now: 0,
        events,
        threads,
        thread_of,
        top: (0..cores).map(|_| VecDeque::new()).collect(),
        interrupts: vec![0; cores],
        holder: vec![None; cores],
        waiting: vec![0; count],
        registers: vec![vec![vec![None; chains]; hosts]; count],
        starts: vec![Vec::new(); chains],
        reflected: vec![None; chains],
        overran: vec![false; count],
        seen: Seen::new(model),
        rng,
    };
    let tick_from = machine.rng.random_range(0..50);
    while machine.now < UNTIL {
        machine.step(tick_from);
    }
    let Machine { mut seen, overran, .. } = machine;
    // What exceeds its budget may be as late as it likes, and so may chains through it.
    for i in (0..count).filter(|i| overran[*i]) {
        (seen.responses[i], seen.queues[i]) = (0, 0);
    }
    for (i, path) in model.chains.iter().enumerate() {
        if path.iter().any(|stage| overran[*stage]) {
            (seen.latencies[i], seen.ages[i], seen.reactions[i]) = (0, 0, 0);
        }
    }
    seen
}

impl Machine<'_> {
    fn step(&mut self, tick_from: u64) {
        for event in self.events.remove(&self.now).unwrap_or_default() {
            match event {
                Event::Register(topic, host, tags) => self.registers[topic][host] = tags,
                Event::Gateway(core) => self.top[core].push_back((self.model.gateway, None)),
                Event::Message(message) => {
                    let i = message.callback;
                    self.waiting[i] += 1;
                    self.seen.queues[i] = self.seen.queues[i].max(self.waiting[i]);
                    match self.model.per_message {
                        0 => self.wake(message),
                        cost => self.top[self.model.callbacks[i].core].push_back((cost, Some(message))),
                    }
                }
            }
        }
        for core in 0..self.model.hosts.len() {
            if let Some((period, wcet)) = self.model.tick
                && self.now % period == tick_from % period
            {
                self.interrupts[core] += wcet;
            }
            self.run(core);
        }
        self.now += 1;
    }

    /// The sampler hands a message to its thread; a timer keeps only its newest release.
    fn wake(&mut self, message: Message) {
        let callback = &self.model.callbacks[message.callback];
        let (i, thread) = (message.callback, &mut self.threads[self.thread_of[message.callback]]);
        if let Budget::Reserved(runtime, period) = callback.budget
            && thread.job.is_none()
            && thread.queue.is_empty()
        {
            // The server's rule for a thread that is woken.
            let rest = thread.refill_at.saturating_sub(self.now);
            if rest == 0 || thread.left * period > rest * runtime {
                (thread.left, thread.refill_at) = (runtime, self.now + period);
            }
        }
        let queue = &mut thread.queue;
        let is_timer = callback.triggers.is_empty() && !callback.is_outside;
        let most = if is_timer {
            1
        } else if callback.budget == Budget::Tell {
            usize::MAX
        } else {
            DEPTH
        };
        let is_alike = |other: &Message| (other.callback, other.topic) == (i, message.topic);
        while queue.iter().filter(|other| is_alike(other)).count() >= most {
            let oldest = queue.iter().position(is_alike).unwrap_or(0);
            queue.remove(oldest);
            self.waiting[i] -= 1;
        }
        queue.push(message);
    }

    fn run(&mut self, core: usize) {
        if self.interrupts[core] > 0 {
            self.interrupts[core] -= 1;
            return;
        }
        let here = |thread: &Thread| thread.core == core;
        let is_stiff = |thread: &Thread| {
            here(thread)
                && thread.job.as_ref().is_some_and(|job| {
                    job.done > 0 && self.model.callbacks[job.message.callback].is_non_preemptive
                })
        };
        if let Some(at) = self.threads.iter().position(is_stiff) {
            self.work(at);
            return;
        }
        loop {
            let best =
                (0..self.threads.len()).filter(|at| self.is_ready(core, *at)).max_by_key(|at| self.rank(*at));
            let reserved = best.is_some_and(|at| self.rank(at) == 100);
            if !reserved && let Some((left, _)) = self.top[core].front_mut() {
                *left -= 1;
                if *left == 0
                    && let Some((_, Some(message))) = self.top[core].pop_front()
                {
                    self.wake(message);
                }
                return;
            }
            let Some(at) = best else { return };
            if self.threads[at].job.is_none() {
                self.begin(at);
                // It may be demoted from the start.
                continue;
            }
            if self.may_go_on(core, at) {
                self.work(at);
                return;
            }
        }
    }

    fn is_ready(&self, core: usize, at: usize) -> bool {
        let thread = &self.threads[at];
        thread.core == core
            && !thread.is_blocked
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
            _ => callback.priority,
        };
        if self.holder[thread.core] != Some(at) {
            return own;
        }
        let users = self.threads.iter().filter(|other| other.core == thread.core);
        let users = users.filter(|other| match self.model.is_ceiling {
            true => other.members.iter().any(|i| self.model.callbacks[*i].lock.is_some()),
            false => other.is_blocked,
        });
        users.map(|other| self.model.callbacks[other.members[0]].priority).max().unwrap_or(0).max(own)
    }

    fn begin(&mut self, at: usize) {
        let thread = &mut self.threads[at];
        let i = thread.queue[0].callback;
        let group = self.model.callbacks[i].group;
        let is_fifo = group.is_none_or(|group| self.model.groups[group]);
        let many = self.model.callbacks[i].triggers.len() > 1;
        let next = match is_fifo {
            true if group.is_none() && !many => 0,
            true if group.is_some() => {
                (0..thread.queue.len()).min_by_key(|m| thread.queue[*m].order).unwrap_or(0)
            }
            // Each callback takes its own messages in their order.
            _ => {
                let m = self.rng.random_range(0..thread.queue.len());
                let of = thread.queue[m].callback;
                thread.queue.iter().position(|message| message.callback == of).unwrap_or(m)
            }
        };
        let mut message = thread.queue.remove(next);
        let i = message.callback;
        let callback = &self.model.callbacks[i];
        let may_overrun = self.is_wild && callback.budget != Budget::Tell && self.rng.random_bool(0.4);
        let most = if may_overrun { callback.wcet * 3 + 2 } else { callback.wcet };
        let work = match self.rng.random_bool(0.7) {
            true => most,
            false => self.rng.random_range(callback.bcet.max(1)..=most),
        };
        self.overran[i] |= work > callback.wcet;
        let lock = callback
            .lock
            .filter(|(_, length)| *length <= work)
            .map(|(_, length)| (self.rng.random_range(0..=work - length), length));
        for (chain, path) in self.model.chains.iter().enumerate() {
            let Some(stage) = path.iter().position(|stage| *stage == i) else { continue };
            if stage == 0 {
                self.starts[chain].push(self.now);
                message.tags[chain] = Some((self.starts[chain].len() - 1, message.base));
            } else if !triggers(self.model, path[stage - 1], i) {
                message.tags[chain] = self.registers[path[stage - 1]][self.model.hosts[callback.core]][chain];
            }
        }
        let thread = &mut self.threads[at];
        let budget = callback.wcet + self.model.per_message;
        if callback.budget == Budget::Suspend {
            thread.is_behind &= message.order < thread.refill_at;
            if !thread.is_behind {
                let period = self.model.period(i);
                (thread.left, thread.refill_at) =
                    (budget, message.order.max(self.now.saturating_sub(period)) + period);
            }
        }
        let is_demoted =
            callback.budget == Budget::Demote && message.order <= thread.low_until && thread.low_until > 0;
        thread.job = Some(Job { message, work, done: 0, lock, is_demoted, used: 0 });
    }

    /// Whether a job has a budget and its lock; otherwise it is demoted, sleeps or waits.
    fn may_go_on(&mut self, core: usize, at: usize) -> bool {
        let thread = &mut self.threads[at];
        let Some(job) = &mut thread.job else { return false };
        let i = job.message.callback;
        let budget = self.model.callbacks[i].wcet + self.model.per_message;
        match self.model.callbacks[i].budget {
            Budget::Demote if job.used >= budget && !job.is_demoted => {
                job.is_demoted = true;
                return false;
            }
            Budget::Suspend | Budget::Reserved(..) if thread.left == 0 => {
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
                return thread.asleep_until <= self.now;
            }
            _ => {}
        }
        if job.lock.is_some_and(|(offset, _)| offset == job.done) && self.holder[core] != Some(at) {
            if self.holder[core].is_some() {
                thread.is_blocked = true;
                return false;
            }
            self.holder[core] = Some(at);
        }
        true
    }

    fn work(&mut self, at: usize) {
        let thread = &mut self.threads[at];
        thread.left = thread.left.saturating_sub(1);
        let core = thread.core;
        let Some(job) = &mut thread.job else { return };
        job.done += 1;
        job.used += 1;
        let is_released = job.lock.is_some_and(|(offset, length)| job.done == offset + length);
        let is_done = job.done == job.work;
        if is_released {
            self.holder[core] = None;
            self.threads
                .iter_mut()
                .filter(|other| other.core == core)
                .for_each(|other| other.is_blocked = false);
        }
        if is_done && let Some(job) = self.threads[at].job.take() {
            self.end(at, &job);
        }
    }

    fn end(&mut self, at: usize, job: &Job) {
        let (i, now) = (job.message.callback, self.now + 1);
        self.waiting[i] -= 1;
        if job.is_demoted {
            self.threads[at].low_until = now;
        }
        self.seen.responses[i] = self.seen.responses[i].max(now - job.message.base);
        let mut tags = job.message.tags.clone();
        for (chain, path) in self.model.chains.iter().enumerate() {
            if !path.contains(&i) {
                tags[chain] = None;
            }
            let Some((source, base)) = tags[chain].filter(|_| path.last() == Some(&i)) else { continue };
            self.seen.latencies[chain] = self.seen.latencies[chain].max(now - base);
            self.seen.ages[chain] = self.seen.ages[chain].max(now - base);
            let first = &self.model.callbacks[path[0]];
            if first.triggers.is_empty() && !first.is_outside {
                // Events just after the start of the job before are reflected for the first time.
                for event in self.reflected[chain].map_or(source, |last| last + 1)..=source {
                    if let Some(missed) = event.checked_sub(1) {
                        self.seen.reactions[chain] =
                            self.seen.reactions[chain].max(now - self.starts[chain][missed]);
                    }
                }
            }
            self.reflected[chain] = self.reflected[chain].max(Some(source));
        }
        self.publish(i, now, &tags);
    }

    fn at(&mut self, at: u64, event: Event) {
        self.events.entry(at.max(self.now + 1)).or_default().push(event);
    }

    fn publish(&mut self, from: usize, now: u64, tags: &[Tag]) {
        let Callback { core, also, .. } = self.model.callbacks[from];
        let host = self.model.hosts[core];
        for topic in [Some(from), also].into_iter().flatten() {
            if self.model.gateway > 0 {
                self.at(now, Event::Gateway(core));
            }
            for other in 0..=self.model.hosts.iter().copied().max().unwrap_or(0) {
                let (least, most) = self.model.network;
                let at = if other == host { now } else { now + self.rng.random_range(least..=most) };
                self.at(at, Event::Register(topic, other, tags.to_vec()));
                let mut served = Vec::new();
                let model = self.model;
                for (i, to) in model.callbacks.iter().enumerate() {
                    let is_taker = to.triggers.contains(&topic);
                    if self.model.hosts[to.core] != other || !(is_taker || to.reads == Some(topic)) {
                        continue;
                    }
                    if other != host && self.model.gateway > 0 && !served.contains(&to.core) {
                        served.push(to.core);
                        self.at(at, Event::Gateway(to.core));
                    }
                    if is_taker {
                        let mut tags = tags.to_vec();
                        for (chain, path) in self.model.chains.iter().enumerate() {
                            let follows = path.windows(2).any(|pair| pair == [from, i]);
                            tags[chain] = tags[chain].filter(|_| follows);
                        }
                        let message = Message { callback: i, topic, base: at, order: at, tags };
                        self.at(at, Event::Message(message));
                    }
                }
            }
        }
    }
}
