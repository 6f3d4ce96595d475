// SPDX-License-Identifier: MIT OR Apache-2.0
use crate::{Hold, Task};

/// A critical section: the longest time for which a task holds a lock. Sections do not nest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CriticalSection {
    /// Index of the task.
    pub task: usize,
    /// Which lock.
    pub resource: usize,
    /// The longest time it is held.
    pub length_ns: u64,
}

/// How a lock changes the priority of the task that holds it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LockProtocol {
    /// `PTHREAD_PRIO_PROTECT`: the holder runs at the lock's ceiling, the highest priority of its users.
    PriorityCeiling,
    /// `PTHREAD_PRIO_INHERIT`: the holder runs at the highest priority that waits for it.
    PriorityInheritance,
}

/// How long each task of a core can be blocked by lower priorities that hold locks: the value for
/// [`Task::blocking_ns`] (Sha, Rajkumar & Lehoczky 1990).
///
/// Only sections of lower priority count whose lock is also used at the task's priority or above. A task that may be demoted counts as
/// lower, too: it may be in its section, demoted, when the task is released. Under the ceiling
/// protocol the longest of them blocks, once. Under inheritance each lower task may block once, and so may each lock:
/// the smaller of the two sums. Sections of tasks that do not exist are ignored.
///
/// ```
/// use std::time::Duration;
/// use tautline_analysis::{CriticalSection, LockProtocol, Task, blocking};
/// let ms = Duration::from_millis;
/// let tasks = [
///     Task::new("high", ms(10), ms(2), 3),
///     Task::new("middle", ms(20), ms(2), 2),
///     Task::new("low", ms(50), ms(9), 1),
/// ];
/// let section = |task, resource, length_ns| CriticalSection { task, resource, length_ns };
/// let sections = [section(0, 0, 5), section(1, 1, 7), section(2, 0, 30), section(0, 1, 5)];
/// assert_eq!(blocking(&tasks, &sections, LockProtocol::PriorityCeiling), [30, 30, 0]);
/// assert_eq!(blocking(&tasks, &sections, LockProtocol::PriorityInheritance), [37, 30, 0]);
/// ```
pub fn blocking(tasks: &[Task], sections: &[CriticalSection], protocol: LockProtocol) -> Vec<u64> {
    let priority = |section: &CriticalSection| tasks.get(section.task).map(Task::highest);
    let ceiling = |resource| sections.iter().filter(|s| s.resource == resource).filter_map(priority).max();
    let of_task = |(index, task): (usize, &Task)| {
        let is_own = |other: usize| {
            other == index
                || (task.group.is_some() && tasks[other].group.map(|g| g.id) == task.group.map(|g| g.id))
        };
        let is_lower = |s: &CriticalSection| {
            let holder = tasks.get(s.task).filter(|_| !is_own(s.task));
            holder.is_some_and(|holder| {
                holder.lowest() < task.lowest() || matches!(holder.hold, Hold::Demoted { .. })
            })
        };
        let blocks = |s: &&CriticalSection| is_lower(s) && ceiling(s.resource) >= Some(task.lowest());
        let blocking: Vec<_> = sections.iter().filter(blocks).collect();
        match protocol {
            LockProtocol::PriorityCeiling => blocking.iter().map(|s| s.length_ns).max().unwrap_or(0),
            LockProtocol::PriorityInheritance => {
                sum_of_longest(&blocking, |s| s.task).min(sum_of_longest(&blocking, |s| s.resource))
            }
        }
    };
    tasks.iter().enumerate().map(of_task).collect()
}

/// The longest section of each class, summed.
fn sum_of_longest(sections: &[&CriticalSection], class: impl Fn(&CriticalSection) -> usize) -> u64 {
    let mut sorted = sections.to_vec();
    sorted.sort_by_key(|s| (class(s), std::cmp::Reverse(s.length_ns)));
    sorted.dedup_by_key(|s| class(s));
    sorted.iter().fold(0, |sum, s| sum.saturating_add(s.length_ns))
}
