// SPDX-License-Identifier: MIT OR Apache-2.0
//! The one fixed-point search behind all bounds: a task, the thread it runs in, and everything that delays it.
use std::cell::{Cell, RefCell};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, HashMap, btree_map};

use crate::release::Release;
use crate::validate::validate;
use crate::{AnalysisError, Group, Hold, Order, Overheads, Rank, Reservation, Task};

mod curve;
mod lowered;

use curve::{Curve, Demand, WHOLE_CORE, merge};

/// Ends the search where utilisation is so close to 1 that the busy window is practically endless.
const MAX_ITERATIONS: u32 = 100_000;

/// The first of the tasks of a core that trigger one another, up to a given task, where each is in every level that the next is in.
///
/// A busy window of such a level begins idle. So each job of the last task in the window comes from a release of the first task in it, and
/// has ended when the window ends.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct First {
    /// Its releases, with as many more as joins on the way may have kept.
    pub release: Release,
    /// How much later the last task's nominal release is; `None` after a join.
    pub lag_ns: Option<u64>,
}

impl First {
    /// Returns when the last task ends, after its nominal release, in a busy window of this length.
    pub fn latest_ns(&self, busy_ns: u64) -> u64 {
        let latest_ns = busy_ns.saturating_add(self.release.jitter_ns);
        self.lag_ns.map_or(u64::MAX, |lag_ns| latest_ns.saturating_sub(lag_ns))
    }
}

/// The tasks of one core, checked, with their costs.
pub(crate) struct Core<'a> {
    tasks: &'a [Task],
    callbacks: Vec<Demand>,
    /// The demand of each task as the others see it: the same, except for tasks with a reservation or an enforced budget.
    delays: Vec<Demand>,
    /// The work per message of each task.
    messages: Vec<u64>,
    /// What a job of each task costs at the ceiling of its thread, if that lowers itself.
    waits_ns: Vec<u64>,
    /// The demand that delays every level: messages, and relays.
    common: Curve,
    /// What delays even sections that nothing else preempts: ticks, throttling.
    interrupts: Curve,
    /// The priorities, the highest first, each with its tasks' delays, except for threads that lower themselves, and the longest section of
    /// all below it.
    bands: Vec<(u8, Curve, u64)>,
    /// For each task that others of this core lead to, the first of these.
    firsts: &'a [Option<First>],
    /// The tasks of each thread that several tasks share.
    threads: HashMap<u32, Vec<usize>>,
    /// Those of these threads that run some of their jobs below their priority.
    lowered: Vec<Lowered>,
    /// The bounds of threads that were computed already, by thread and rank, and the windows of `lowered` by thread.
    known: RefCell<HashMap<(u32, Rank), Result<Shared, AnalysisError>>>,
    windows: RefCell<HashMap<u32, Result<Shared, AnalysisError>>>,
    /// A task that is released too often at once, if there is one.
    burst: Option<AnalysisError>,
    throttled: bool,
    /// How much more work one period of the throttling may have before it throttles.
    spare_ns: u64,
    effort: Option<&'a Effort>,
}

#[cfg(test)]
std::thread_local! {
    /// All steps of this thread.
    pub(crate) static STEPS: Cell<u64> = const { Cell::new(0) };
}

/// Counts the steps of searches for bounds, and may end them.
#[derive(Debug)]
pub(crate) struct Effort {
    steps: Cell<u64>,
    most: u64,
    /// Whether a search is over once its bound is past the deadline.
    until_late: bool,
}

impl Effort {
    /// Counts steps without a limit.
    pub fn unlimited() -> Self {
        Self { steps: Cell::new(0), most: u64::MAX, until_late: false }
    }

    /// Ends a search without a bound after `most` steps, or once it is past the deadline: to find out whether deadlines are met.
    pub fn until_late(most: u64) -> Self {
        Self { steps: Cell::new(0), most, until_late: true }
    }

    pub fn is_until_late(&self) -> bool {
        self.until_late
    }

    pub fn steps(&self) -> u64 {
        self.steps.get()
    }
}

/// A thread of which some jobs run below its ceiling.
#[derive(Debug)]
struct Lowered {
    members: Vec<usize>,
    group: u32,
    /// The lowest priority of its jobs.
    floor: u8,
    ceiling: u8,
}

impl Lowered {
    /// Returns those of a core.
    fn all(tasks: &[Task]) -> Vec<Self> {
        let mut all: Vec<Self> = Vec::new();
        for (i, task) in tasks.iter().enumerate() {
            let Some(Group { id, .. }) = task.group else { continue };
            match all.iter_mut().find(|thread| thread.group == id) {
                Some(thread) => {
                    thread.members.push(i);
                    thread.floor = thread.floor.min(task.lowest());
                }
                None => all.push(Self {
                    members: vec![i],
                    group: id,
                    floor: task.lowest(),
                    ceiling: task.priority,
                }),
            }
        }
        all.retain(|thread| thread.floor < thread.ceiling);
        all
    }
}

/// The bounds that all tasks of a thread have in common.
#[derive(Debug, Clone, Copy)]
struct Shared {
    /// The longest response from an arrival.
    arrival_ns: u64,
    busy_ns: u64,
    /// From the begin of the busy window to the end of the thread's last job.
    end_ns: u64,
    utilisation: f64,
}

/// The response times found for one task: from its nominal release, and from its arrival, at most the jitter later.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bound {
    pub nominal_ns: u64,
    pub arrival_ns: u64,
    /// From the nominal release to the end of a job for this release or for a later one.
    pub reflected_ns: u64,
    /// How much is released within this time may delay it: its longest busy window.
    pub busy_ns: u64,
    pub utilisation: f64,
    /// Whether it may wait for the next period of its reservation.
    pub waits: bool,
}

impl<'a> Core<'a> {
    pub fn new(tasks: &'a [Task], overheads: &Overheads) -> Result<Self, AnalysisError> {
        Self::beside(tasks, &[], overheads, &[], 0)
    }

    /// As [`new`](Self::new), on a core that also relays messages, each with its releases and its cost, and that may stall for `stall_ns`.
    /// The blocking of all tasks contains the stall already; the work that piled up meanwhile is done at once.
    pub fn beside(
        tasks: &'a [Task],
        firsts: &'a [Option<First>],
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
        let mut callbacks: Vec<_> = tasks.iter().map(charged).collect::<Result<_, AnalysisError>>()?;
        for (own, first) in callbacks.iter_mut().zip(firsts) {
            let Some(First { release, .. }) = first else { continue };
            if release.jitter_ns <= own.release.jitter_ns {
                let distance_ns = release.min_distance_ns.max(own.release.min_distance_ns);
                own.release = release.clone().min_distance(distance_ns);
            }
        }
        let delays: Vec<_> = tasks
            .iter()
            .zip(&callbacks)
            .map(|(task, own)| delay(task, own, overheads))
            .collect::<Result<_, _>>()?;
        let messages: Vec<u64> = tasks.iter().map(|task| task.per_message_ns(overheads)).collect();
        let mut common: Vec<Demand> =
            tasks.iter().zip(&messages).map(|(task, ns)| demand(task, *ns)).collect();
        common.extend(
            relays.iter().map(|(release, cost_ns)| Demand { release: release.clone(), cost_ns: *cost_ns }),
        );
        let mut interrupts = Vec::new();
        if overheads.tick_period_ns > 0 {
            let release = Release::periodic(overheads.tick_period_ns);
            interrupts.push(Demand { release, cost_ns: overheads.tick_ns });
        }
        let (mut throttled, mut spare_ns) = (false, u64::MAX);
        if let Some(limit) = overheads.throttling.filter(|limit| limit.runtime_ns < limit.period_ns) {
            let mut all = delays.iter().chain(&common).chain(&interrupts);
            let window = limit.period_ns.saturating_add(stall_ns);
            let work = all.try_fold(0, |sum: u64, demand| sum.checked_add(demand.within(window)?));
            spare_ns = limit.runtime_ns.saturating_sub(work.unwrap_or(u64::MAX));
            throttled = work.is_none_or(|work| work > limit.runtime_ns);
            if throttled {
                let release = Release::periodic(limit.period_ns);
                interrupts.push(Demand { release, cost_ns: limit.period_ns - limit.runtime_ns });
            }
        }
        let curve = |demands: Vec<Demand>| {
            let unnamed = || AnalysisError::Overflow {
                task: tasks.first().map_or(String::new(), |task| task.name.clone()),
            };
            Curve::new(demands).ok_or_else(unnamed)
        };
        let lowered = Lowered::all(tasks);
        let mut is_lowered = vec![false; tasks.len()];
        lowered.iter().flat_map(|thread| &thread.members).for_each(|i| is_lowered[*i] = true);
        let waits_ns = tasks.iter().map(|task| task.waits_ns(overheads)).collect();
        let mut by_priority: BTreeMap<u8, (Vec<Demand>, u64)> = BTreeMap::new();
        let mut threads: HashMap<u32, Vec<usize>> = HashMap::new();
        for (i, task) in tasks.iter().enumerate() {
            let (demands, section_ns) = by_priority.entry(task.lowest()).or_default();
            demands.extend((!is_lowered[i]).then(|| delays[i].clone()));
            *section_ns = task.non_preemptive_ns.max(*section_ns);
            if let Some(group) = task.group {
                threads.entry(group.id).or_default().push(i);
            }
        }
        let (mut bands, mut below_ns) = (Vec::with_capacity(by_priority.len()), 0);
        for (priority, (demands, section_ns)) in by_priority {
            bands.push((priority, curve(demands)?, below_ns));
            below_ns = section_ns.max(below_ns);
        }
        bands.reverse();
        let burst = tasks.iter().find_map(|task| {
            let releases = task.release().most_within(1);
            let error =
                || AnalysisError::LongBurst { task: task.name.clone(), releases, jitter_ns: task.jitter_ns };
            let is_bunched = matches!(task.hold, Hold::Suspended { .. }) && task.jitter_ns >= task.period_ns;
            let bunched = || AnalysisError::Bunched { task: task.name.clone() };
            (releases > 1_000_000).then(error).or_else(|| is_bunched.then(bunched))
        });
        let (common, interrupts) = (curve(common)?, curve(interrupts)?);
        Ok(Self {
            tasks,
            callbacks,
            delays,
            messages,
            waits_ns,
            common,
            interrupts,
            bands,
            firsts,
            threads,
            lowered,
            known: RefCell::default(),
            windows: RefCell::default(),
            burst,
            throttled,
            spare_ns: if throttled { u64::MAX } else { spare_ns },
            effort: None,
        })
    }

    /// Limits searches by `effort`; a search that it ends returns an error of any kind.
    pub fn with_effort(mut self, effort: &'a Effort) -> Self {
        self.effort = Some(effort);
        self
    }

    /// Whether the kernel may pause this core's real-time threads; their bounds then contain the pauses.
    pub fn throttled(&self) -> bool {
        self.throttled
    }

    /// Counts a step of a search; whether there may be more.
    fn count_step(&self) -> bool {
        #[cfg(test)]
        STEPS.set(STEPS.get() + 1);
        self.effort.is_none_or(|effort| {
            effort.steps.set(effort.steps.get() + 1);
            effort.steps.get() <= effort.most
        })
    }

    /// How much more work a period of the throttling may have before it throttles; the maximum without it, or if it does.
    pub fn spare_ns(&self) -> u64 {
        self.spare_ns
    }

    /// The first of the tasks that lead to this one, if any do.
    pub fn first(&self, index: usize) -> Option<&First> {
        self.firsts.get(index)?.as_ref()
    }

    pub fn bound(&self, index: usize) -> Result<Bound, AnalysisError> {
        match &self.burst {
            Some(error) => Err(error.clone()),
            None => {
                let found = self.bound_of(&self.tasks[index], index)?;
                let latest_ns = self.first(index).map_or(u64::MAX, |first| first.latest_ns(found.busy_ns));
                Ok(Bound { nominal_ns: found.nominal_ns.min(latest_ns), ..found })
            }
        }
    }

    fn bound_of(&self, task: &Task, index: usize) -> Result<Bound, AnalysisError> {
        let shares = |group: &Group| self.threads.get(&group.id).is_some_and(|members| members.len() > 1);
        let Some(group) = task.group.filter(shares) else { return Level::new(self, index)?.bound() };
        // All tasks of a thread have one bound, or those of one rank.
        let key = (group.id, if group.order == Order::Priority { task.rank } else { Rank::Of(0) });
        let known = self.known.borrow().get(&key).cloned();
        let shared = known.unwrap_or_else(|| {
            let found = match self.lowered(task) {
                Some(thread) => self.of_lowered(thread, task.rank),
                None => Level::new(self, index).and_then(|level| level.of_thread(group.order)),
            };
            self.known.borrow_mut().insert(key, found.clone());
            found
        });
        let Shared { arrival_ns, busy_ns, end_ns, utilisation } = shared?;
        let nominal_ns = arrival_ns.checked_add(task.jitter_ns).ok_or_else(|| overflow(task))?;
        // The newest release of a timer is queued behind earlier work, and the thread may reach it as late as possible.
        let reflected_ns = busy_ns.checked_add(task.jitter_ns).ok_or_else(|| overflow(task))?;
        let busy_ns = busy_ns.max(end_ns);
        Ok(Bound { nominal_ns, arrival_ns, reflected_ns, busy_ns, utilisation, waits: false })
    }
}

/// One task and everything that can delay it.
struct Level<'a> {
    core: &'a Core<'a>,
    task: &'a Task,
    release: Release,
    /// The releases by which its jobs in a busy window are counted.
    counted: Release,
    /// The tasks of its thread that `bands` contain: itself, and those that share the thread; none if the thread lowers itself.
    members: Vec<usize>,
    /// The demand of its thread, without jobs of lower ranks; for a timer of a thread that goes by ranks, none.
    own: Curve,
    /// The cost of one of its own jobs.
    cost_ns: u64,
    /// Its priority and those above; the lowest of its thread's, if that lowers itself.
    bands: &'a [(u8, Curve, u64)],
    /// The demand of other threads that lower themselves.
    others: Curve,
    /// The gap that its reservation leaves in each period, as work above it.
    gap: Option<Demand>,
    /// What a job costs at the highest priority, in part in its own thread.
    message_ns: u64,
    /// The longest section of a lower priority that nothing preempts.
    sections: u64,
    /// As `sections`, with all else of lower priorities, and of its thread's rounds, that blocks it.
    blocking: u64,
    /// The rest of a job once nothing can preempt it.
    tail: u64,
    utilisation: u128,
}

impl<'a> Level<'a> {
    fn new(core: &'a Core, index: usize) -> Result<Self, AnalysisError> {
        let task = &core.tasks[index];
        let lowered = core.lowered(task);
        let floor = lowered.map_or(task.priority, |thread| thread.floor);
        let shared = task.group.and_then(|group| core.threads.get(&group.id));
        let members = shared.cloned().unwrap_or_else(|| vec![index]);
        // What each rank, and the timers, may add to a round.
        let (mut blocking, mut ranks_ns, mut timers_ns) = (0, BTreeMap::<u8, u64>::new(), 0_u64);
        for &i in &members {
            let other = &core.tasks[i];
            if other.priority != task.priority || other.group != task.group {
                let (task, other) = (task.name.clone(), other.name.clone());
                return Err(AnalysisError::MixedGroup { task, other });
            }
            blocking = other.blocking_ns.max(blocking);
            let jobs_ns = match other.rank {
                Rank::Of(rank) => ranks_ns.entry(rank).or_default(),
                Rank::Timer { .. } => &mut timers_ns,
            };
            *jobs_ns = jobs_ns.saturating_add(core.callbacks[i].cost_ns);
        }
        // Another thread of this priority may have waited during many rounds: no window begins with what is left of one.
        let is_here = |other: &&Task| other.priority == task.priority || other.lowest() == task.priority;
        let is_alone = || core.tasks.iter().filter(is_here).count() == members.len();
        // Joins that may run several times in a round count as often as they are released, as does what is above them; beside a timer, so does all.
        let repeated = members.iter().map(|i| &core.tasks[*i]).filter(|other| other.repeats);
        let repeated = repeated.map(|other| other.rank).min();
        let is_ranked = lowered.is_none()
            && members.len() > 1
            && task.group.is_some_and(|group| group.order == Order::Priority)
            && is_alone()
            && !(task.rank.is_timer() && repeated.is_some());
        let rank = repeated.unwrap_or(task.rank).min(task.rank);
        let longest_ns = |ranks: btree_map::Range<u8, u64>| ranks.map(|(_, ns)| *ns).max().unwrap_or(0);
        // The least rank whose demand counts, and what rounds add to it: see `of_thread`.
        let (least, rounds_ns) = match rank {
            _ if !is_ranked => (Some(Rank::Of(0)), 0),
            Rank::Of(of) => (Some(rank), timers_ns.saturating_add(longest_ns(ranks_ns.range(..of)))),
            Rank::Timer { is_first } => {
                let others_ns = longest_ns(ranks_ns.range(..)).saturating_mul(if is_first { 1 } else { 2 });
                (None, timers_ns.saturating_mul(2).saturating_add(others_ns))
            }
        };
        let is_own = |i: &&usize| least.is_some_and(|least| core.tasks[**i].rank >= least);
        let bands = &core.bands[..core.bands.partition_point(|(priority, ..)| *priority >= floor)];
        // A section delays only if it began before: at least 1 ns of it is over.
        let sections = bands.last().map_or(0, |(_, _, below_ns)| below_ns.saturating_sub(1));
        // The end of a reservation preempts everything, and a job that waits for a lock gives up the core after it began.
        let is_whole =
            task.non_preemptive_ns >= task.wcet_ns && task.reservation.is_none() && task.lock_waits == 0;
        let tail = if is_whole { task.wcet_ns - 1 } else { 0 };
        let own = members.iter().filter(is_own).map(|i| core.callbacks[*i].clone());
        let own = Curve::new(own).ok_or_else(|| overflow(task))?;
        let others = Curve::new(core.demand_of_lowered(floor, task.group)?).ok_or_else(|| overflow(task))?;
        let blocking = u64::checked_add(blocking, sections).and_then(|sum| sum.checked_add(rounds_ns));
        let level = Self {
            core,
            task,
            release: task.release(),
            counted: core.callbacks[index].release.clone(),
            members: if lowered.is_none() { members } else { Vec::new() },
            own,
            cost_ns: core.callbacks[index].cost_ns,
            bands,
            others,
            gap: None,
            message_ns: core.messages[index],
            sections,
            blocking: blocking.ok_or_else(|| overflow(task))?,
            tail,
            utilisation: 0,
        };
        level.with_utilisation()
    }

    /// All demand that delays the thread.
    fn curves(&self) -> impl Iterator<Item = &Curve> {
        let all = [&self.others, &self.core.common, &self.core.interrupts];
        self.bands.iter().map(|(_, curve, _)| curve).chain(all)
    }

    /// Computes the utilisation, without the demand of its own thread as others see it.
    fn with_utilisation(mut self) -> Result<Self, AnalysisError> {
        let gap = self.gap.iter().map(Demand::utilisation);
        let all = self
            .curves()
            .map(|curve| Some(curve.utilisation))
            .chain(gap)
            .chain([Some(self.own.utilisation)])
            .try_fold(0, |sum: u128, part| sum.checked_add(part?))
            .ok_or_else(|| overflow(self.task))?;
        let own = self.members.iter().map(|i| self.core.delays[*i].utilisation());
        self.utilisation = all - own.sum::<Option<u128>>().ok_or_else(|| overflow(self.task))?;
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
        let charged_ns = self.cost_ns.saturating_add(self.message_ns);
        let apart_ns = self.release.shortest_span(1);
        let spare_ns = runtime_ns.checked_sub(charged_ns).filter(|_| apart_ns >= period_ns);
        if let (Some(spare_ns), Ok(())) = (spare_ns, self.check_load()) {
            // When all work that comes first is done: the wake-up may be as late.
            let late_ns = self.finish(self.add(self.blocking, 1)?, 0, u64::MAX, &mut 0)? - 1;
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
        let mut gap_ns = period_ns - runtime_ns;
        // A section may begin in each gap, and last beyond it. The server makes up for that in the next periods, so that only the last one
        // counts, unless it is more than a period behind: then it begins anew.
        match self.sections {
            section_ns if section_ns > period_ns => gap_ns = self.add(gap_ns, section_ns)?,
            section_ns => self.blocking = self.add(self.blocking, section_ns)?,
        }
        self.gap = Some(Demand { release: Release::periodic(period_ns), cost_ns: gap_ns });
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
        let (nominal_ns, arrival_ns, busy_ns) = self.alone()?;
        Ok(Bound {
            nominal_ns,
            arrival_ns,
            reflected_ns: nominal_ns,
            busy_ns,
            utilisation: self.utilisation_f64(),
            waits: false,
        })
    }

    /// The bounds of a thread, or of one rank of a thread that goes by ranks.
    ///
    /// Such a thread is an executor of ROS 2. In each round it waits, then it runs one job of each timer that was due, and one of each task
    /// of the highest rank of which any was ready. Waiting is part of the job that follows. A timer that is late has one job to run,
    /// however many periods have passed.
    ///
    /// *A job of rank r.* Let t be the last instant, up to its arrival, before which no job of rank r or above was waiting or running. From
    /// then until it ends each wait finds such a job, so no further round has a lower rank. The job that the thread runs at t is a timer's or
    /// of a lower rank, and so no job of rank r or above was waiting when it began, at s. The thread had the core at s, so no
    /// work above it was waiting. Of each timer one job may have been, and in this round jobs of one lower rank may be left: these are
    /// the `blocking`. All else that the core does until the job ends is released from s on, so a busy window that begins at s
    /// bounds the response. Lower ranks may have run in many rounds while only timers were ready, but those ended before s. If the thread runs
    /// nothing at t, the window begins as usual, when the core last had nothing to do at this priority or above, and nothing of the thread waits.
    /// If a join of a lower rank may make several sets in a round, the window is that of the join's rank, in which all above it end, too.
    ///
    /// *A timer.* It may be due right after a wait. Of that round, at most one job of each timer and those of one rank are left; from
    /// the begin of the one that runs, nothing above the thread waits, as before. The next round runs the timer after one job of each other
    /// timer, and, if timers are not first, after those of one rank. What else is released in the thread waits for another round.
    fn of_thread(&self, order: Order) -> Result<Shared, AnalysisError> {
        self.check_load()?;
        let busy_ns = self.busy_window()?;
        let (arrival_ns, end_ns) = match order {
            Order::Fifo => self.first_in_first_out(busy_ns)?,
            Order::Any | Order::Priority => (busy_ns, busy_ns),
        };
        Ok(Shared { arrival_ns, busy_ns, end_ns, utilisation: self.utilisation_f64() })
    }

    /// Refuses overload, and full levels with blocking or jitter. Rounding down hides under one unit per demand: so close to 1 is full.
    fn check_load(&self) -> Result<(), AnalysisError> {
        let (task, priority) = (self.task.name.clone(), self.task.priority);
        if self.utilisation > WHOLE_CORE {
            return Err(AnalysisError::Overload { task, priority, utilisation: self.utilisation_f64() });
        }
        let curves = || self.curves().chain([&self.own]);
        let parts: usize = curves().map(|curve| curve.parts).sum();
        let full = self.utilisation + parts as u128 + 1 > WHOLE_CORE;
        if full && (self.blocking > 0 || curves().any(|curve| curve.is_irregular)) {
            return Err(AnalysisError::NoSlack { task, priority });
        }
        Ok(())
    }

    /// A task with a thread of its own: the longest response of the jobs of one busy window (Lehoczky 1990, with
    /// Tindell's jitter). A job that cannot be preempted ends its `tail` after it began (Davis et al. 2007); work that
    /// came meanwhile may delay the next one, so there the search goes on to the end of the busy window.
    fn alone(&self) -> Result<(u64, u64, u64), AnalysisError> {
        let jitter = self.task.jitter_ns;
        let window = if self.tail > 0 { self.busy_window()? } else { 0 };
        let (mut nominal, mut arrival, mut busy, mut iterations) = (0, 0, window, 0);
        let (mut work, mut end) = (self.blocking, 0);
        for job in 0.. {
            work = self.add(work, self.cost_ns)?;
            let latest = match self.core.effort.is_some_and(Effort::is_until_late) {
                true => self.release.shortest_span(job).saturating_add(self.task.deadline_ns),
                false => u64::MAX,
            };
            end = self.finish(work - self.tail, end, latest, &mut iterations)?;
            let finish = self.without_preemption(end, &mut iterations)?;
            busy = busy.max(finish);
            // The first job's nominal release may lie its jitter before the window, so this never falls below zero.
            nominal = nominal.max(self.add(finish, jitter)?.saturating_sub(self.release.nominal_span(job)));
            arrival = arrival.max(finish - self.release.shortest_span(job).min(finish));
            if self.counted.most_within(finish.max(window)) <= job + 1 {
                break;
            }
        }
        if self.task.unordered && jitter >= self.release.nominal_span(1) {
            // Its place in the queue does not follow from its nominal release.
            nominal = self.add(arrival, jitter)?;
        }
        Ok((nominal, arrival, busy))
    }

    /// Returns when a job ends that only interrupts delay from `start` on.
    fn without_preemption(&self, start: u64, iterations: &mut u32) -> Result<u64, AnalysisError> {
        let mut end = self.add(start, self.tail)?;
        if self.tail == 0 {
            return Ok(end);
        }
        let interrupts = |window| self.core.interrupts.within(window).ok_or_else(|| overflow(self.task));
        let before = interrupts(start)?;
        let work = end;
        loop {
            self.count(iterations)?;
            let next = self.add(work, interrupts(end)? - before)?;
            if next == end {
                return Ok(end);
            }
            end = next;
        }
    }

    /// A thread whose jobs run in the order of their release: a late job keeps its place, so that jobs whose releases the least distance
    /// keeps apart may be queued at once. The longest response is that of a job that arrives when some
    /// task of the thread is released, as early as its curve allows (Bedarkar et al., ECRTS 2022).
    fn first_in_first_out(&self, window: u64) -> Result<(u64, u64), AnalysisError> {
        let nominal = |i: &usize| {
            let Demand { release, cost_ns } = &self.core.callbacks[*i];
            Demand { release: release.clone().min_distance(0), cost_ns: *cost_ns }
        };
        let own = merge(self.members.iter().map(nominal).collect());
        let queue = Curve::new(own.iter().cloned()).ok_or_else(|| overflow(self.task))?;
        let (mut longest, mut end, mut iterations) = (0, 0, 0);
        // The next offset at which each is released.
        let first = |demand: &Demand| demand.release.shortest_span(demand.release.most_within(1));
        let mut offsets: BinaryHeap<_> =
            own.iter().enumerate().map(|(i, demand)| Reverse((first(demand), i))).collect();
        let mut offset = 0;
        while offset < window {
            let closed = self.add(offset, 1)?;
            let queued = queue.within(closed).and_then(|queued| queued.checked_add(self.blocking));
            end = self.finish(queued.ok_or_else(|| overflow(self.task))?, end, u64::MAX, &mut iterations)?;
            longest = longest.max(end.saturating_sub(offset));
            let Some(Reverse((next, _))) = offsets.peek().copied() else { break };
            offset = next;
            while let Some(Reverse((_, i))) = offsets.peek().copied().filter(|Reverse((at, _))| *at <= offset)
            {
                offsets.pop();
                let release = &own[i].release;
                offsets.push(Reverse((release.shortest_span(release.most_within(self.add(offset, 1)?)), i)));
            }
        }
        Ok((longest, end))
    }

    /// The longest time that this level keeps the core busy, which bounds any job's response in any order.
    fn busy_window(&self) -> Result<u64, AnalysisError> {
        let mut iterations = 0;
        let own = |window| {
            self.own
                .within(window)
                .and_then(|own| own.checked_add(self.blocking))
                .ok_or_else(|| overflow(self.task))
        };
        let mut window = own(1)?;
        loop {
            let next = self.delayed(own(window)?, window)?;
            if next == window {
                return Ok(window);
            }
            window = next;
            self.count(&mut iterations)?;
        }
    }

    /// Least fixed point of `work` plus interference, searched upwards from `window`, which must not exceed it, and no further than `latest`.
    fn finish(
        &self,
        work: u64,
        window: u64,
        latest: u64,
        iterations: &mut u32,
    ) -> Result<u64, AnalysisError> {
        let mut window = window.max(work);
        loop {
            self.count(iterations)?;
            let next = self.delayed(work, window)?;
            if next == window {
                return Ok(window);
            }
            if next > latest {
                *iterations = MAX_ITERATIONS;
            }
            window = next;
        }
    }

    /// `work` and all that others release within a window.
    fn delayed(&self, work: u64, window: u64) -> Result<u64, AnalysisError> {
        let others = || {
            let all = self.curves().try_fold(0, |sum: u64, curve| sum.checked_add(curve.within(window)?))?;
            let own = self
                .members
                .iter()
                .try_fold(0, |sum: u64, i| sum.checked_add(self.core.delays[*i].within(window)?))?;
            let gap = self.gap.as_ref().map_or(Some(0), |gap| gap.within(window))?;
            (all - own).checked_add(gap)?.checked_add(work)
        };
        others().ok_or_else(|| overflow(self.task))
    }

    fn count(&self, iterations: &mut u32) -> Result<(), AnalysisError> {
        *iterations += 1;
        if self.core.count_step() && *iterations <= MAX_ITERATIONS {
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

/// Returns a task's demand on others: its own, its enforced budget, or a reservation's runtime and switches, two per period and per job.
fn delay(task: &Task, own: &Demand, overheads: &Overheads) -> Result<Demand, AnalysisError> {
    let Some(Reservation { runtime_ns, period_ns }) = task.reservation else {
        if task.hold == Hold::Nothing {
            return Ok(own.clone());
        }
        // The budget has room for all work per message, of which the sampler does a part in addition; after it comes another switch.
        let more = task.per_message_ns(overheads).saturating_add(overheads.context_switch_ns);
        let mut budget = own.cost_ns.checked_add(more);
        let release = match task.hold {
            Hold::Demoted { section_ns } => {
                budget = budget.and_then(|budget| budget.checked_add(section_ns));
                own.release.clone()
            }
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
