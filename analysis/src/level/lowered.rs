// SPDX-License-Identifier: MIT OR Apache-2.0
//! Threads that run each job at a priority of its own: `thread_priority = "callback"`.
//!
//! Such a thread has its ceiling while it waits, takes a job or runs a timer, and the job's own priority while it runs that. Its jobs do not
//! preempt one another. The lowest of its priorities is its floor. In what follows, a level is a priority q with all above it.
//!
//! *What it takes from a task of another thread, at priority q.* If q is above the ceiling, nothing. If q is at the floor or below, all of its
//! jobs, as if they had one priority. In between, consider the last instant z, up to the task's arrival, at which neither another thread has
//! work of level q nor this one is at a priority of q or above. From then until the task ends the core has work of level q, so a job below q
//! that has begun goes on only afterwards, with what waits behind it in the thread. What the thread does at q or above in this time are whole
//! jobs of priority q or above, timers, and of lower jobs the executor's part, until the job has been taken. They have arrived since z, or they
//! have waited, up to z, for a job below q that ended then. That job's round began when none of them was there, and the core has
//! been busy at the floor's level since: they arrived at most the floor's longest busy window before z. So jitter of that length covers them.
//!
//! *Its own jobs.* While it has work, the core has work of the floor's level. So that level's busy window, with all jobs of the thread, bounds each
//! response: [`Core::window`]. [`Core::by_rank`] has bounds that leave out jobs of lower ranks.
use super::{Core, Curve, Demand, Level, Lowered, MAX_ITERATIONS, Shared};
use crate::{AnalysisError, Group, Order, Rank, Task};

impl Core<'_> {
    /// The thread of a task, if its jobs have priorities of their own.
    pub(super) fn lowered(&self, task: &Task) -> Option<&Lowered> {
        self.lowered.iter().find(|thread| task.group.is_some_and(|group| group.id == thread.group))
    }

    /// Returns what these threads take from level `level` of others, and of the thread `own`.
    pub(super) fn demand_of_lowered(
        &self,
        level: u8,
        own: Option<Group>,
    ) -> Result<Vec<Demand>, AnalysisError> {
        let is_other = |thread: &&Lowered| own.is_none_or(|own| own.id != thread.group);
        let mut demands = Vec::new();
        for thread in self.lowered.iter().filter(is_other).filter(|thread| thread.ceiling >= level) {
            let late_ns = if thread.floor >= level { 0 } else { self.window(thread)?.busy_ns };
            for &i in &thread.members {
                let task = &self.tasks[i];
                let is_whole = task.rank.is_timer() || task.lowest() >= level;
                let cost_ns = if is_whole { self.delays[i].cost_ns } else { self.waits_ns[i] };
                demands.push(Demand { release: later(task, late_ns), cost_ns });
            }
        }
        Ok(demands)
    }

    /// The busy window of a thread's floor: a bound for each of its jobs.
    fn window(&self, thread: &Lowered) -> Result<Shared, AnalysisError> {
        let known = self.windows.borrow().get(&thread.group).cloned();
        known.unwrap_or_else(|| {
            let found = Level::new(self, thread.members[0]).and_then(|level| level.of_thread(Order::Any));
            self.windows.borrow_mut().insert(thread.group, found.clone());
            found
        })
    }

    /// The bounds of a task of such a thread.
    pub(super) fn of_lowered(&self, thread: &Lowered, rank: Rank) -> Result<Shared, AnalysisError> {
        let all = self.window(thread)?;
        let ranked_ns = self.by_rank(thread, rank).unwrap_or(u64::MAX);
        let latest_ns = all.busy_ns.min(ranked_ns);
        Ok(Shared { arrival_ns: latest_ns, busy_ns: latest_ns, end_ns: latest_ns, ..all })
    }

    /// Returns a bound of the jobs of one rank, or of the timers, of a thread that goes by ranks; `None` where none is known but
    /// [`Core::window`]. It has rounds as described at [`Level::of_thread`].
    ///
    /// *A job of rank r.* Let t be the last instant, up to its arrival, before which no job of rank r or above was waiting or running.
    ///
    /// - The thread runs at t a job of a round with a lower rank l, which began at s. Then no job of rank r or above waited, and nothing above the
    ///   ceiling, for the thread had the core. Other threads below the ceiling, however, may have waited while the thread ran higher ranks, from
    ///   before s: what of theirs is left at s arrived less than their response times before. The rest of the round, one job at most of each
    ///   timer and those of rank l, runs at l or above, so it ends within the least fixed point D of this work and of what others above l
    ///   release in it, those below the ceiling with a jitter of their response times. The thread has the core at l
    ///   when it goes from the last of these jobs back to its ceiling: nothing above l waits. From there on the thread runs timers and jobs of rank r and above only, at r or
    ///   above, so the rest is the least fixed point V of those that were released within D + V, and of what others above r release within V.
    /// - It runs a timer of a round without messages, or nothing. Then the window begins with that timer, or when the thread went on from its last job,
    ///   or when nothing above r waited, whichever was last. Others above r and below the ceiling may wait from before, as above, but not what is
    ///   above the ceiling.
    ///
    /// *A timer.* Of a round that has begun, D is left for the worst l. The next one begins at the ceiling, with the timers; if these are not
    /// first, another D ends it.
    ///
    /// All of this needs that the thread, as it leaves a job, is at that job's priority without work above it: so jobs have no
    /// non-preemptive sections, no other thread has a priority of this one's, and none between floor and ceiling is held to a budget.
    fn by_rank(&self, thread: &Lowered, rank: Rank) -> Option<u64> {
        let members = || thread.members.iter().map(|i| (*i, &self.tasks[*i]));
        let is_plain = |task: &Task| {
            task.group.is_some_and(|group| group.order == Order::Priority)
                && !task.repeats
                && !task.is_held()
                && task.non_preemptive_ns == 0
        };
        if self.lowered.len() > 1 || !members().all(|(_, task)| is_plain(task)) {
            return None;
        }
        let waiting_ns = self.waiting_ns(thread)?;
        let mut ranks: Vec<(u8, u64)> = Vec::new();
        let (mut timers_ns, mut blocking_ns) = (0_u64, 0);
        for (i, task) in members() {
            let cost_ns = self.callbacks[i].cost_ns;
            blocking_ns = task.blocking_ns.max(blocking_ns);
            match task.rank {
                Rank::Timer { .. } => timers_ns = timers_ns.checked_add(cost_ns)?,
                Rank::Of(rank) => match ranks.iter_mut().find(|(of, _)| *of == rank) {
                    Some((_, ns)) => *ns = ns.checked_add(cost_ns)?,
                    None => ranks.push((rank, cost_ns)),
                },
            }
        }
        // What is left of a round with the worst of these ranks, or D; 0 if there is none.
        let rest_ns = |is_such: &dyn Fn(u8) -> bool| {
            ranks.iter().filter(|(of, _)| is_such(*of)).try_fold(0, |longest: u64, (of, jobs_ns)| {
                let work_ns = blocking_ns.checked_add(timers_ns)?.checked_add(*jobs_ns)?;
                let others = self.above(thread, self.level_of(thread, *of), Some(&waiting_ns))?;
                Some(longest.max(self.fixed_point(work_ns, 0, &Curve::default(), &others)?))
            })
        };
        let Rank::Of(of) = rank else {
            let rest_ns = rest_ns(&|_| true)?;
            let sections_ns = self.sections_below(thread, thread.ceiling);
            if rank != (Rank::Timer { is_first: true }) {
                return rest_ns.checked_mul(2)?.checked_add(sections_ns);
            }
            let others = self.above(thread, thread.ceiling, None)?;
            let work_ns = blocking_ns.checked_add(timers_ns)?.checked_add(sections_ns)?;
            return rest_ns.checked_add(self.fixed_point(work_ns, 0, &Curve::default(), &others)?);
        };
        let own = members().filter(|(_, task)| task.rank >= rank).map(|(i, _)| self.callbacks[i].clone());
        let own = Curve::new(own)?;
        let level = self.level_of(thread, of);
        let first_ns = rest_ns(&|other| other < of)?;
        let others = self.above(thread, level, None)?;
        let after_ns = first_ns.checked_add(self.fixed_point(blocking_ns, first_ns, &own, &others)?)?;
        let work_ns = blocking_ns.checked_add(timers_ns)?.checked_add(self.sections_below(thread, level))?;
        let others = self.above(thread, level, Some(&waiting_ns))?;
        let without_ns = self.fixed_point(work_ns, 0, &own, &others)?;
        Some(after_ns.max(without_ns))
    }

    /// The lowest priority at which a thread runs jobs of a rank.
    fn level_of(&self, thread: &Lowered, rank: u8) -> u8 {
        let of = thread.members.iter().map(|i| &self.tasks[*i]).filter(|task| task.rank == Rank::Of(rank));
        of.map(Task::lowest).min().unwrap_or(thread.floor)
    }

    /// Returns for how long each task of other threads may have waited: the response times of those between floor and ceiling. `None` if
    /// one has no bound, or a priority of this thread's.
    fn waiting_ns(&self, thread: &Lowered) -> Option<Vec<u64>> {
        let is_member = |i: usize| thread.members.contains(&i);
        let is_own = |priority: u8| {
            priority == thread.ceiling || thread.members.iter().any(|i| self.tasks[*i].lowest() == priority)
        };
        let waiting = |(i, task): (usize, &Task)| match task.priority {
            _ if is_member(i) => Some(0),
            priority if is_own(priority) => None,
            priority if priority < thread.floor || priority > thread.ceiling => Some(0),
            _ if task.is_held() => None,
            _ => Some(self.bound_of(task, i).ok()?.arrival_ns),
        };
        self.tasks.iter().enumerate().map(waiting).collect()
    }

    /// What delays a thread at `level`; with how long others may have waited, or if none has.
    fn above(&self, thread: &Lowered, level: u8, waiting_ns: Option<&[u64]>) -> Option<Curve> {
        let others = (0..self.tasks.len()).filter(|i| !thread.members.contains(i));
        let others = others.filter(|i| self.tasks[*i].priority > level);
        Curve::new(others.map(|i| match waiting_ns.map_or(0, |waiting_ns| waiting_ns[i]) {
            0 => self.delays[i].clone(),
            waiting_ns => {
                Demand { release: later(&self.tasks[i], waiting_ns), cost_ns: self.delays[i].cost_ns }
            }
        }))
    }

    /// The longest section of other threads below `level` that nothing preempts, less what of it must be over.
    fn sections_below(&self, thread: &Lowered, level: u8) -> u64 {
        let others = (0..self.tasks.len()).filter(|i| !thread.members.contains(i)).map(|i| &self.tasks[i]);
        let sections = others.filter(|task| task.lowest() < level).map(|task| task.non_preemptive_ns);
        sections.max().unwrap_or(0).saturating_sub(1)
    }

    /// The least x that is `work_ns`, the thread's own work within `before_ns` and x, and that of others and of the core within x.
    fn fixed_point(&self, work_ns: u64, before_ns: u64, own: &Curve, others: &Curve) -> Option<u64> {
        let mut window_ns = 1;
        for _ in 0..MAX_ITERATIONS {
            let own_ns = own.within(before_ns.checked_add(window_ns)?)?;
            let curves = [others, &self.common, &self.interrupts];
            let next_ns = curves.iter().try_fold(work_ns.checked_add(own_ns)?, |sum, curve| {
                sum.checked_add(curve.within(window_ns)?)
            })?;
            if next_ns <= window_ns {
                return Some(window_ns);
            }
            window_ns = next_ns;
            if !self.count_step() {
                return None;
            }
        }
        None
    }
}

/// The releases of a task whose jobs may wait for `ns` before they count.
fn later(task: &Task, ns: u64) -> crate::Release {
    let release = task.release();
    if ns == 0 {
        return release;
    }
    let jitter_ns = release.jitter_ns.saturating_add(ns);
    release.min_distance(0).jitter(jitter_ns)
}
