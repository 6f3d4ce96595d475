// SPDX-License-Identifier: MIT OR Apache-2.0
use std::time::Duration;

use crate::{AnalysisError, Overheads, Task, queue_capacity};

/// Ends the search where utilisation is so close to 1 that the busy window is practically endless.
const MAX_ITERATIONS: u32 = 1_000_000;

/// Utilisations are compared as fixed-point numbers with 64 fractional bits, rounded down.
const WHOLE_CORE: u128 = 1 << 64;

/// The bound found for one task.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Response {
    /// The task's name.
    pub name: String,
    /// The task's priority.
    pub priority: u8,
    /// Worst-case response time in nanoseconds, from the nominal release to the end of the job, release jitter included.
    pub response_ns: u64,
    /// The task's deadline in nanoseconds.
    pub deadline_ns: u64,
    /// Whether the response time is within the deadline.
    pub met: bool,
    /// The task's period in nanoseconds.
    pub period_ns: u64,
    /// The task's release jitter in nanoseconds.
    pub jitter_ns: u64,
    /// Share of the core needed by all work at this priority and above, overheads included; 1.0 is the whole core.
    pub level_utilisation: f64,
}

impl Response {
    /// The worst-case response time.
    #[must_use]
    pub fn response(&self) -> Duration {
        Duration::from_nanos(self.response_ns)
    }

    /// The queue depth at which this task's subscription loses no message; see [`queue_capacity`].
    ///
    /// # Errors
    /// [`AnalysisError::NoSlack`] if the core is full at this level; [`AnalysisError::Overflow`] past `usize`.
    pub fn queue_capacity(&self) -> Result<usize, AnalysisError> {
        if self.level_utilisation >= 1.0 {
            return Err(AnalysisError::NoSlack { task: self.name.clone(), priority: self.priority });
        }
        let (period, jitter) = (Duration::from_nanos(self.period_ns), Duration::from_nanos(self.jitter_ns));
        queue_capacity(self.response(), period, jitter)
            .ok_or_else(|| AnalysisError::Overflow { task: self.name.clone() })
    }
}

/// Bounds the response time of every task, in the order given, on a machine that costs nothing.
///
/// # Errors
/// The first task that is invalid or has no bound; see [`AnalysisError`].
pub fn response_times(tasks: &[Task]) -> Result<Vec<Response>, AnalysisError> {
    (0..tasks.len()).map(|index| Level::new(tasks, index, None)?.response()).collect()
}

/// Bounds the response time of every task, in the order given, with the cost of context switches and messages.
///
/// # Errors
/// The first task that is invalid or has no bound; see [`AnalysisError`].
pub fn response_times_with_overheads(
    tasks: &[Task],
    overheads: &Overheads,
) -> Result<Vec<Response>, AnalysisError> {
    response_time_per_task(tasks, overheads).into_iter().collect()
}

/// As [`response_times_with_overheads`], with an outcome for each task: where a low priority is overloaded, the bounds
/// of the priorities above it still stand.
#[must_use]
pub fn response_time_per_task(tasks: &[Task], overheads: &Overheads) -> Vec<Result<Response, AnalysisError>> {
    (0..tasks.len()).map(|index| Level::new(tasks, index, Some(overheads))?.response()).collect()
}

/// Work that recurs and delays the task under analysis.
struct Demand {
    period: u128,
    wcet: u128,
    jitter: u128,
}

impl Demand {
    /// Work released within a window that starts at a critical instant, or `None` on overflow.
    fn within(&self, window: u128) -> Option<u128> {
        window.checked_add(self.jitter)?.div_ceil(self.period).checked_mul(self.wcet)
    }

    /// Share of the core, in units of 1 / [`WHOLE_CORE`], rounded down.
    fn utilisation(&self) -> Option<u128> {
        Some(self.wcet.checked_mul(WHOLE_CORE)? / self.period)
    }
}

/// One task and everything that can delay it.
struct Level<'a> {
    task: &'a Task,
    own: Demand,
    interference: Vec<Demand>,
    utilisation: u128,
}

impl<'a> Level<'a> {
    fn new(tasks: &'a [Task], index: usize, overheads: Option<&Overheads>) -> Result<Self, AnalysisError> {
        tasks.iter().try_for_each(validate)?;
        let task = &tasks[index];
        let callback = |task: &Task| Demand {
            period: task.period_ns.into(),
            wcet: u128::from(task.wcet_ns) + 2 * u128::from(overheads.map_or(0, |o| o.context_switch_ns)),
            jitter: task.jitter_ns.into(),
        };
        let message = |task: &Task| Demand {
            wcet: overheads.map_or(0, |o| task.message_overhead_ns.unwrap_or(o.per_message_ns)).into(),
            ..callback(task)
        };
        let competes = |(other, t): &(usize, &Task)| *other != index && t.priority >= task.priority;
        let callbacks = tasks.iter().enumerate().filter(competes).map(|(_, task)| callback(task));
        let messages = tasks.iter().map(message).filter(|demand| demand.wcet > 0);
        let interference: Vec<_> = callbacks.chain(messages).collect();
        let own = callback(task);

        let utilisation = std::iter::once(&own)
            .chain(&interference)
            .try_fold(0, |sum: u128, demand| sum.checked_add(demand.utilisation()?))
            .ok_or_else(|| AnalysisError::Overflow { task: task.name.clone() })?;
        Ok(Self { task, own, interference, utilisation })
    }

    fn response(&self) -> Result<Response, AnalysisError> {
        self.check_load()?;
        let response_ns = u64::try_from(self.longest()?).map_err(|_| self.overflow())?;
        Ok(Response {
            name: self.task.name.clone(),
            priority: self.task.priority,
            response_ns,
            deadline_ns: self.task.deadline_ns,
            met: response_ns <= self.task.deadline_ns,
            period_ns: self.task.period_ns,
            jitter_ns: self.task.jitter_ns,
            level_utilisation: self.utilisation_f64(),
        })
    }

    /// Rounding down hides less than one unit for each demand, which is refused along with exactly 1.
    fn check_load(&self) -> Result<(), AnalysisError> {
        let (task, priority) = (self.task.name.clone(), self.task.priority);
        if self.utilisation > WHOLE_CORE {
            return Err(AnalysisError::Overload { task, priority, utilisation: self.utilisation_f64() });
        }
        let full = self.utilisation + self.interference.len() as u128 + 1 > WHOLE_CORE;
        let delayed = |demand: &Demand| demand.jitter > 0;
        if full && (self.task.blocking_ns > 0 || delayed(&self.own) || self.interference.iter().any(delayed))
        {
            return Err(AnalysisError::NoSlack { task, priority });
        }
        Ok(())
    }

    /// The longest response of the jobs of one busy window (Lehoczky 1990, with Tindell's jitter).
    fn longest(&self) -> Result<u128, AnalysisError> {
        let Demand { period, wcet, jitter } = self.own;
        let (mut longest, mut iterations) = (0, 0);
        let mut own_work = u128::from(self.task.blocking_ns);
        let (mut window, mut arrival) = (own_work, 0);
        loop {
            own_work = own_work.checked_add(wcet).ok_or_else(|| self.overflow())?;
            window = self.finish(own_work, window.max(own_work), &mut iterations)?;
            let delayed = window.checked_add(jitter).ok_or_else(|| self.overflow())?;
            longest = longest.max(delayed - arrival);
            arrival += period;
            if delayed <= arrival {
                return Ok(longest);
            }
        }
    }

    /// Least fixed point of `own_work` plus interference, searched upwards from `window`, which must not exceed it.
    fn finish(&self, own_work: u128, mut window: u128, iterations: &mut u32) -> Result<u128, AnalysisError> {
        loop {
            *iterations += 1;
            if *iterations > MAX_ITERATIONS {
                return Err(AnalysisError::IterationLimit {
                    task: self.task.name.clone(),
                    priority: self.task.priority,
                    utilisation: self.utilisation_f64(),
                    iterations: MAX_ITERATIONS,
                });
            }
            let next = self
                .interference
                .iter()
                .try_fold(own_work, |sum, demand| sum.checked_add(demand.within(window)?))
                .ok_or_else(|| self.overflow())?;
            if next == window {
                return Ok(window);
            }
            window = next;
        }
    }

    fn utilisation_f64(&self) -> f64 {
        self.utilisation as f64 / WHOLE_CORE as f64
    }

    fn overflow(&self) -> AnalysisError {
        AnalysisError::Overflow { task: self.task.name.clone() }
    }
}

fn validate(task: &Task) -> Result<(), AnalysisError> {
    let name = || task.name.clone();
    if task.period_ns == 0 {
        return Err(AnalysisError::ZeroPeriod { task: name() });
    }
    if task.wcet_ns == 0 {
        return Err(AnalysisError::ZeroWcet { task: name() });
    }
    let fields = [
        ("period", task.period_ns),
        ("wcet", task.wcet_ns),
        ("deadline", task.deadline_ns),
        ("jitter", task.jitter_ns),
        ("blocking", task.blocking_ns),
        ("message overhead", task.message_overhead_ns.unwrap_or(0)),
    ];
    match fields.into_iter().find(|(_, ns)| *ns == u64::MAX) {
        Some((field, _)) => Err(AnalysisError::TooLong { task: name(), field }),
        None => Ok(()),
    }
}
