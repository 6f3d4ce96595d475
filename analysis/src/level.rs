// SPDX-License-Identifier: MIT OR Apache-2.0
//! The one fixed-point search behind all bounds: a task, the thread it runs in, and everything that delays it.
use crate::release::Release;
use crate::validate::validate;
use crate::{AnalysisError, Hold, Order, Overheads, Reservation, Task};

/// Ends the search where utilisation is so close to 1 that the busy window is practically endless.
const MAX_ITERATIONS: u32 = 1_000_000;

/// Utilisations are compared as fixed-point numbers with 64 fractional bits, rounded down.
const WHOLE_CORE: u128 = 1 << 64;

/// Work that recurs.
#[derive(Debug, Clone)]
struct Demand {
    release: Release,
    cost_ns: u64,
}

impl Demand {
    /// Work released within a window that starts at a critical instant, or `None` on overflow.
    fn within(&self, window: u64) -> Option<u64> {
        self.release.most_within(window).checked_mul(self.cost_ns)
    }

    /// Share of the core, in units of 1 / [`WHOLE_CORE`], rounded down.
    fn utilisation(&self) -> Option<u128> {
        let (releases, time) = self.release.rate();
        Some(
            u128::from(self.cost_ns).checked_mul(u128::from(releases))?.checked_mul(WHOLE_CORE)?
                / u128::from(time),
        )
    }
}

/// The tasks of one core, checked, with their costs.
pub(crate) struct Core<'a> {
    tasks: &'a [Task],
    /// The demand of each task.
    callbacks: Vec<Demand>,
    /// The demand of each task as the others see it: the same, except for tasks with a reservation.
    delays: Vec<Demand>,
    /// The work per message of each task.
    messages: Vec<u64>,
    /// What delays every level: messages, and what relays them.
    common: Vec<Demand>,
    /// What delays even sections that nothing else preempts: ticks, throttling.
    interrupts: Vec<Demand>,
    throttled: bool,
}

/// The response times found for one task: from its nominal release, and from its arrival, at most the jitter later.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bound {
    pub nominal_ns: u64,
    pub arrival_ns: u64,
    /// From the nominal release to the end of a job for it or for a later one.
    pub reflected_ns: u64,
    pub utilisation: f64,
    /// Whether it may wait for the next period of its reservation.
    pub waits: bool,
}

impl<'a> Core<'a> {
    pub fn new(tasks: &'a [Task], overheads: &Overheads) -> Result<Self, AnalysisError> {
        Self::beside(tasks, overheads, &[], 0)
    }

    /// The same on a core that also relays messages, each with its releases and its cost, and that may stand still for `stall_ns`
    /// besides, as the blocking of all tasks says already: what piled up then is done at once.
    pub fn beside(
        tasks: &'a [Task],
        overheads: &Overheads,
        relays: &[(Release, u64)],
        stall_ns: u64,
    ) -> Result<Self, AnalysisError> {
        tasks.iter().try_for_each(validate)?;
        let demand = |task: &Task, cost_ns| Demand { release: task.release(), cost_ns };
        let charged = |task: &Task| match task.charged_ns(overheads) {
            u64::MAX => Err(overflow(task)),
            cost => Ok(demand(task, cost)),
        };
        let callbacks: Vec<_> = tasks.iter().map(charged).collect::<Result<_, AnalysisError>>()?;
        let delays: Vec<_> = tasks
            .iter()
            .zip(&callbacks)
            .map(|(task, own)| delay(task, own, overheads))
            .collect::<Result<_, _>>()?;
        let messages: Vec<u64> = tasks.iter().map(|task| task.per_message_ns(overheads)).collect();
        let mut common: Vec<_> = tasks.iter().zip(&messages).map(|(task, ns)| demand(task, *ns)).collect();
        common.extend(
            relays.iter().map(|(release, cost_ns)| Demand { release: release.clone(), cost_ns: *cost_ns }),
        );
        let mut interrupts = Vec::new();
        if overheads.tick_period_ns > 0 {
            let release = Release::periodic(overheads.tick_period_ns);
            interrupts.push(Demand { release, cost_ns: overheads.tick_ns });
        }
        let mut throttled = false;
        if let Some(limit) = overheads.throttling.filter(|limit| limit.runtime_ns < limit.period_ns) {
            let mut all = delays.iter().chain(&common).chain(&interrupts);
            let window = limit.period_ns.saturating_add(stall_ns);
            let work = all.try_fold(0, |sum: u64, demand| sum.checked_add(demand.within(window)?));
            throttled = work.is_none_or(|work| work > limit.runtime_ns);
            if throttled {
                let release = Release::periodic(limit.period_ns);
                interrupts.push(Demand { release, cost_ns: limit.period_ns - limit.runtime_ns });
            }
        }
        Ok(Self { tasks, callbacks, delays, messages, common: merge(common), interrupts, throttled })
    }

    /// Whether the kernel may pause this core's real-time threads; their bounds then contain the pauses.
    pub fn throttled(&self) -> bool {
        self.throttled
    }

    pub fn bound(&self, index: usize) -> Result<Bound, AnalysisError> {
        Level::new(self, index)?.bound()
    }
}

/// One task and everything that can delay it.
struct Level<'a> {
    task: &'a Task,
    release: Release,
    /// The demand of its thread: its own, and that of the tasks that share the thread.
    own: Vec<Demand>,
    interference: Vec<Demand>,
    /// What of this even delays the rest of a job that nothing else preempts.
    interrupts: &'a [Demand],
    /// What a job costs at the highest priority, in part in its own thread.
    message_ns: u64,
    blocking: u64,
    /// The rest of a job once nothing can preempt it.
    tail: u64,
    utilisation: u128,
}

impl<'a> Level<'a> {
    fn new(core: &'a Core, index: usize) -> Result<Self, AnalysisError> {
        let task = &core.tasks[index];
        let shares = |(i, other): (usize, &Task)| {
            i == index || (task.group.is_some() && other.group.map(|g| g.id) == task.group.map(|g| g.id))
        };
        let mut own = Vec::new();
        let mut interference: Vec<_> = core.common.iter().chain(&core.interrupts).cloned().collect();
        let (mut blocking, mut sections) = (0, 0);
        for (i, other) in core.tasks.iter().enumerate() {
            let releases = other.release().most_within(1);
            if releases > u64::from(MAX_ITERATIONS) {
                let (task, jitter_ns) = (other.name.clone(), other.jitter_ns);
                return Err(AnalysisError::LongBurst { task, releases, jitter_ns });
            }
            if shares((i, other)) {
                if other.priority != task.priority || other.group != task.group {
                    let (task, other) = (task.name.clone(), other.name.clone());
                    return Err(AnalysisError::MixedGroup { task, other });
                }
                own.push(core.callbacks[i].clone());
                blocking = other.blocking_ns.max(blocking);
            } else if other.priority >= task.priority {
                interference.push(core.delays[i].clone());
            } else {
                // A section delays only if it began before: at least 1 ns of it is over.
                sections = other.non_preemptive_ns.saturating_sub(1).max(sections);
            }
        }
        // The end of a reservation preempts everything.
        let is_whole = task.non_preemptive_ns >= task.wcet_ns && task.reservation.is_none();
        let tail = if is_whole { task.wcet_ns - 1 } else { 0 };
        let interference = merge(interference);
        let blocking = u64::checked_add(blocking, sections).ok_or_else(|| overflow(task))?;
        let (interrupts, message_ns) = (core.interrupts.as_slice(), core.messages[index]);
        let release = task.release();
        let level =
            Self { task, release, own, interference, interrupts, message_ns, blocking, tail, utilisation: 0 };
        level.with_utilisation()
    }

    fn with_utilisation(mut self) -> Result<Self, AnalysisError> {
        self.utilisation = (self.own.iter().chain(&self.interference))
            .try_fold(0, |sum: u128, demand| sum.checked_add(demand.utilisation()?))
            .ok_or_else(|| overflow(self.task))?;
        Ok(self)
    }

    fn bound(self) -> Result<Bound, AnalysisError> {
        if let Some(reservation) = self.task.reservation {
            return self.reserved(reservation);
        }
        self.bound_without_gaps()
    }

    /// A task with a reservation: nothing holds it up while it has runtime, so all that matters is when it may have none.
    ///
    /// A job that is woken finds the whole runtime, in a period of its own, if the one before has ended and left more of the runtime
    /// than is left of its period (the rule of the server for a thread that is woken). What is left of the period is at most
    /// what the wake-up before may have been late, for releases that are a period apart. Otherwise the runtime may be used up, from the begin
    /// on, until the period ends, and again after each runtime: it is as if something above took the rest of each period.
    fn reserved(mut self, reservation: Reservation) -> Result<Bound, AnalysisError> {
        let Reservation { runtime_ns, period_ns } = reservation;
        let charged_ns = self.own[0].cost_ns.saturating_add(self.message_ns);
        let apart_ns = self.release.shortest_span(1);
        let spare_ns = runtime_ns.checked_sub(charged_ns).filter(|_| apart_ns >= period_ns);
        if let (Some(spare_ns), Ok(())) = (spare_ns, self.check_load()) {
            // Until when all that comes first is done: the wake-up may be as late.
            let late_ns = self.finish(self.add(self.blocking, 1)?, 0, &mut 0)? - 1;
            let left_ns = late_ns.saturating_sub(apart_ns - period_ns);
            let rule = |ns: u64, of: u64| u128::from(ns) * u128::from(of);
            let is_left = left_ns == 0
                || rule(spare_ns, period_ns)
                    > rule(left_ns.saturating_add(Reservation::GRANULARITY_NS), runtime_ns);
            let bound = self.bound_without_gaps()?;
            if is_left && bound.arrival_ns <= apart_ns {
                return Ok(bound);
            }
        }
        let name = self.task.name.clone();
        self.interference
            .push(Demand { release: Release::periodic(period_ns), cost_ns: period_ns - runtime_ns });
        let bound = self.with_utilisation()?.bound_without_gaps().map_err(|error| match error {
            AnalysisError::Overload { .. } | AnalysisError::NoSlack { .. } => {
                AnalysisError::SmallReservation { task: name, charged_ns, runtime_ns, period_ns }
            }
            error => error,
        })?;
        Ok(Bound { waits: runtime_ns < period_ns, ..bound })
    }

    fn bound_without_gaps(&self) -> Result<Bound, AnalysisError> {
        self.check_load()?;
        let mut late_ns = 0;
        let (nominal_ns, arrival_ns) = match self.task.group {
            Some(group) if self.own.len() > 1 => {
                let arrival = match group.order {
                    Order::Fifo => {
                        late_ns = self.busy_window()?;
                        self.first_in_first_out()?
                    }
                    Order::Any => self.busy_window()?,
                };
                (self.add(arrival, self.task.jitter_ns)?, arrival)
            }
            _ => self.alone()?,
        };
        // The newest release of a timer goes behind what came before it, and the thread may get to it as late as possible.
        let reflected_ns = nominal_ns.max(self.add(late_ns, self.task.jitter_ns)?);
        Ok(Bound { nominal_ns, arrival_ns, reflected_ns, utilisation: self.utilisation_f64(), waits: false })
    }

    /// Rounding down hides less than one unit for each demand, which is refused along with exactly 1.
    fn check_load(&self) -> Result<(), AnalysisError> {
        let (task, priority) = (self.task.name.clone(), self.task.priority);
        if self.utilisation > WHOLE_CORE {
            return Err(AnalysisError::Overload { task, priority, utilisation: self.utilisation_f64() });
        }
        let demands = self.own.len() + self.interference.len();
        let full = self.utilisation + demands as u128 > WHOLE_CORE;
        let irregular = |demand: &Demand| demand.release.jitter_ns > 0 || demand.release.distances.is_some();
        if full && (self.blocking > 0 || self.own.iter().chain(&self.interference).any(irregular)) {
            return Err(AnalysisError::NoSlack { task, priority });
        }
        Ok(())
    }

    /// A task with a thread of its own: the longest response of the jobs of one busy window (Lehoczky 1990, with
    /// Tindell's jitter). A job that cannot be preempted ends its `tail` after it began (Davis et al. 2007); work that
    /// came meanwhile may delay the next one, so there the search goes on to the end of the busy window.
    fn alone(&self) -> Result<(u64, u64), AnalysisError> {
        let jitter = self.task.jitter_ns;
        let window = if self.tail > 0 { self.busy_window()? } else { 0 };
        let (mut nominal, mut arrival, mut iterations) = (0, 0, 0);
        let (mut work, mut end) = (self.blocking, 0);
        for job in 0.. {
            work = self.add(work, self.own[0].cost_ns)?;
            end = self.finish(work - self.tail, end, &mut iterations)?;
            let finish = self.without_preemption(end, &mut iterations)?;
            // The first job's nominal release may lie its jitter before the window, so this never falls below zero.
            nominal = nominal.max(self.add(finish, jitter)?.saturating_sub(self.release.nominal_span(job)));
            arrival = arrival.max(finish - self.release.shortest_span(job).min(finish));
            let next = self.release.shortest_span(job + 1);
            if next >= finish && next >= window {
                break;
            }
        }
        if self.task.unordered && jitter >= self.release.nominal_span(1) {
            // Its place in the queue is not that of its nominal release.
            nominal = self.add(arrival, jitter)?;
        }
        Ok((nominal, arrival))
    }

    /// When a job ends that nothing but interrupts delays from `start` on.
    fn without_preemption(&self, start: u64, iterations: &mut u32) -> Result<u64, AnalysisError> {
        let mut end = self.add(start, self.tail)?;
        if self.tail == 0 {
            return Ok(end);
        }
        let before = self.demand(0, self.interrupts, start)?;
        let work = end;
        loop {
            self.count(iterations)?;
            let next = self.demand(work, self.interrupts, end)? - before;
            if next == end {
                return Ok(end);
            }
            end = next;
        }
    }

    /// A thread whose jobs run in the order of their release: a late one keeps its place, so that what the least distance of releases
    /// keeps apart may be queued at once. The longest response is that of a job that arrives when some
    /// task of the thread is released, as early as its curve allows (Bedarkar et al., ECRTS 2022).
    fn first_in_first_out(&self) -> Result<u64, AnalysisError> {
        let window = self.busy_window()?;
        let nominal = |demand: &Demand| Demand { release: demand.release.clone().min_distance(0), ..*demand };
        let own: Vec<_> = self.own.iter().map(nominal).collect();
        let (mut longest, mut end, mut iterations, mut offset) = (0, 0, 0, 0);
        while offset < window {
            let closed = self.add(offset, 1)?;
            let queued = self.demand(self.blocking, &own, closed)?;
            end = self.finish(queued, end, &mut iterations)?;
            longest = longest.max(end.saturating_sub(offset));
            let next = |demand: &Demand| demand.release.shortest_span(demand.release.most_within(closed));
            offset = own.iter().map(next).min().unwrap_or(u64::MAX);
        }
        Ok(longest)
    }

    /// The longest time that this level keeps the core busy, which bounds any job's response in any order.
    fn busy_window(&self) -> Result<u64, AnalysisError> {
        let mut iterations = 0;
        let mut window = self.demand(self.blocking, &self.own, 1)?;
        loop {
            let own = self.demand(self.blocking, &self.own, window)?;
            let next = self.demand(own, &self.interference, window)?;
            if next == window {
                return Ok(window);
            }
            window = next;
            self.count(&mut iterations)?;
        }
    }

    /// Least fixed point of `work` plus interference, searched upwards from `window`, which must not exceed it.
    fn finish(&self, work: u64, window: u64, iterations: &mut u32) -> Result<u64, AnalysisError> {
        let mut window = window.max(work);
        loop {
            self.count(iterations)?;
            let next = self.demand(work, &self.interference, window)?;
            if next == window {
                return Ok(window);
            }
            window = next;
        }
    }

    /// `work` and what the demands release within a window.
    fn demand(&self, work: u64, demands: &[Demand], window: u64) -> Result<u64, AnalysisError> {
        let mut all = demands.iter();
        all.try_fold(work, |sum, demand| sum.checked_add(demand.within(window)?))
            .ok_or_else(|| overflow(self.task))
    }

    fn count(&self, iterations: &mut u32) -> Result<(), AnalysisError> {
        *iterations += 1;
        if *iterations <= MAX_ITERATIONS {
            return Ok(());
        }
        Err(AnalysisError::IterationLimit {
            task: self.task.name.clone(),
            priority: self.task.priority,
            utilisation: self.utilisation_f64(),
            iterations: MAX_ITERATIONS,
        })
    }

    fn add(&self, a: u64, b: u64) -> Result<u64, AnalysisError> {
        a.checked_add(b).ok_or_else(|| overflow(self.task))
    }

    fn utilisation_f64(&self) -> f64 {
        self.utilisation as f64 / WHOLE_CORE as f64
    }
}

/// Drops what costs nothing and joins what is released alike: systems have fewer rates than callbacks.
fn merge(mut demands: Vec<Demand>) -> Vec<Demand> {
    demands.retain(|demand| demand.cost_ns > 0);
    let key = |d: &Demand| (d.release.period_ns, d.release.jitter_ns, d.release.min_distance_ns);
    demands.sort_by_key(key);
    demands.dedup_by(|next, kept| {
        let joint = kept.cost_ns.checked_add(next.cost_ns).filter(|_| kept.release == next.release);
        kept.cost_ns = joint.unwrap_or(kept.cost_ns);
        joint.is_some()
    });
    demands
}

/// What a task takes from others. One that is held to its budget: that budget. A reservation: its runtime, switching to it and from it, once for the period and once for each job.
fn delay(task: &Task, own: &Demand, overheads: &Overheads) -> Result<Demand, AnalysisError> {
    let Some(Reservation { runtime_ns, period_ns }) = task.reservation else {
        if task.hold == Hold::Nothing {
            return Ok(own.clone());
        }
        // A budget has room for all work per message, of which the sampler does a part besides.
        let budget = own.cost_ns.checked_add(task.per_message_ns(overheads));
        let release = match task.hold {
            // What is left of one budget may be used right before the next.
            Hold::Suspended { deferred: true } => Release::periodic(task.period_ns).jitter(task.period_ns),
            _ => own.release.clone(),
        };
        return Ok(Demand { release, cost_ns: budget.ok_or_else(|| overflow(task))? });
    };
    let switches = own.release.most_within(period_ns).saturating_add(1).saturating_mul(2);
    let cost_ns = switches.checked_mul(overheads.context_switch_ns).and_then(|ns| ns.checked_add(runtime_ns));
    let release = Release::periodic(period_ns).jitter(period_ns);
    Ok(Demand { release, cost_ns: cost_ns.ok_or_else(|| overflow(task))? })
}

fn overflow(task: &Task) -> AnalysisError {
    AnalysisError::Overflow { task: task.name.clone() }
}
