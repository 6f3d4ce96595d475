// SPDX-License-Identifier: MIT OR Apache-2.0
use std::time::Duration;

use crate::level::{Core, First};
use crate::{AnalysisError, Overheads, Release, Task};

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
    /// Worst-case time in nanoseconds from the actual release, such as a message's publication, to the end of the job.
    pub from_arrival_ns: u64,
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
    /// Whether a job may find its [`Reservation`](crate::Reservation) used up and wait for the next period.
    pub waits_for_reservation: bool,
    /// From the nominal release to the end of a job for it or for a later release, in nanoseconds: a timer keeps only its newest release.
    pub(crate) reflected_ns: u64,
    /// Its longest busy window: all that is released within this time may delay it.
    pub(crate) busy_ns: u64,
    pub(crate) release: Release,
    /// The first of the tasks of its core that lead to it, if any do.
    pub(crate) first: Option<First>,
}

impl Response {
    /// The worst-case response time.
    pub fn response(&self) -> Duration {
        Duration::from_nanos(self.response_ns)
    }

    /// The queue depth at which this task's subscription loses no message, the one its callback is working on
    /// included: the most that can arrive within one response time (from arrival), and at least 1.
    ///
    /// # Errors
    /// [`AnalysisError::NoSlack`] if the core is full at this level; [`AnalysisError::Overflow`] past `usize`.
    pub fn queue_capacity(&self) -> Result<usize, AnalysisError> {
        if self.level_utilisation >= 1.0 {
            return Err(AnalysisError::NoSlack { task: self.name.clone(), priority: self.priority });
        }
        // All waiting messages come from releases of the first task in one busy window.
        let most = self.first.as_ref().map_or(u64::MAX, |first| first.release.most_within(self.busy_ns));
        usize::try_from(self.release.most_within(self.from_arrival_ns).min(most).max(1))
            .map_err(|_| AnalysisError::Overflow { task: self.name.clone() })
    }

    /// Returns the worse of both bounds, for a task that may run on either core.
    pub(crate) fn or_worse(mut self, other: &Response) -> Self {
        self.response_ns = self.response_ns.max(other.response_ns);
        self.from_arrival_ns = self.from_arrival_ns.max(other.from_arrival_ns);
        self.reflected_ns = self.reflected_ns.max(other.reflected_ns);
        self.busy_ns = self.busy_ns.max(other.busy_ns);
        self.level_utilisation = self.level_utilisation.max(other.level_utilisation);
        self.waits_for_reservation |= other.waits_for_reservation;
        self.met = self.response_ns <= self.deadline_ns;
        self
    }

    pub(crate) fn of(core: &Core, task: &Task, index: usize) -> Result<Self, AnalysisError> {
        let bound = core.bound(index)?;
        Ok(Self {
            name: task.name.clone(),
            priority: task.priority,
            response_ns: bound.nominal_ns,
            from_arrival_ns: bound.arrival_ns,
            deadline_ns: task.deadline_ns,
            met: bound.nominal_ns <= task.deadline_ns,
            period_ns: task.period_ns,
            jitter_ns: task.jitter_ns,
            level_utilisation: bound.utilisation,
            waits_for_reservation: bound.waits,
            reflected_ns: bound.reflected_ns,
            busy_ns: bound.busy_ns,
            release: task.release(),
            first: core.first(index).cloned(),
        })
    }
}

/// Bounds the response time of every task, in the order given, on a machine without overheads.
///
/// # Errors
/// The first task that is invalid or has no bound; see [`AnalysisError`].
pub fn response_times(tasks: &[Task]) -> Result<Vec<Response>, AnalysisError> {
    let tasks: Vec<_> = tasks.iter().map(Task::without_overheads).collect();
    response_times_with_overheads(&tasks, &Overheads::NONE)
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
pub fn response_time_per_task(tasks: &[Task], overheads: &Overheads) -> Vec<Result<Response, AnalysisError>> {
    match Core::new(tasks, overheads) {
        Ok(core) => tasks.iter().enumerate().map(|(i, task)| Response::of(&core, task, i)).collect(),
        Err(error) => tasks.iter().map(|_| Err(error.clone())).collect(),
    }
}
