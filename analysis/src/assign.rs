// SPDX-License-Identifier: MIT OR Apache-2.0
//! Priorities for the tasks of one core.
use crate::level::Core;
use crate::{AnalysisError, Overheads, Task};

/// Rate-monotonic: the thread with the shortest period gets `highest`, each longer one the next lower. Equal ones come
/// in the order of the tasks, or share a priority if there are not enough for all. A thread with several tasks goes by
/// its shortest period. The result is in the order of the tasks.
///
/// Optimal when every deadline is its period (Liu & Layland 1973).
///
/// # Errors
/// [`AnalysisError::TooFewPriorities`] if it would go below 1.
pub fn rate_monotonic(tasks: &[Task], highest: u8) -> Result<Vec<u8>, AnalysisError> {
    shortest_first(tasks, |task| task.period_ns, highest)
}

/// Deadline-monotonic: the shortest relative deadline gets `highest`, as in [`rate_monotonic`].
///
/// Optimal when deadlines are at most the periods (Leung & Whitehead 1982).
///
/// # Errors
/// As [`rate_monotonic`].
pub fn deadline_monotonic(tasks: &[Task], highest: u8) -> Result<Vec<u8>, AnalysisError> {
    shortest_first(tasks, |task| task.deadline_ns, highest)
}

/// Audsley's assignment (1991): finds an order that meets all deadlines if there is one, also with jitter, blocking
/// that does not depend on priorities, and deadlines past the period. Each thread gets a priority of its own.
///
/// The lowest priority goes to a thread that meets its deadlines there, then the next one; the tasks that are
/// placed above it do not change that. Among several, the one with the longest deadline is taken.
///
/// # Errors
/// [`AnalysisError::NoAssignment`] if there is no such order, [`AnalysisError::TooFewPriorities`] if there are more
/// threads than priorities up to `highest`, or the error of an invalid task.
///
/// ```
/// use std::time::Duration;
/// use tautline_analysis::{Overheads, Task, assign, response_times};
/// let ms = Duration::from_millis;
/// // Late by its jitter: neither rate- nor deadline-monotonic order works.
/// let mut tasks = [Task::new("a", ms(20), ms(5), 0), Task::new("b", ms(25), ms(8), 0).jitter(ms(12))];
/// tasks[0] = tasks[0].clone().deadline(ms(20));
/// tasks[1] = tasks[1].clone().deadline(ms(20));
/// let priorities = assign::audsley(&tasks, &Overheads::NONE, 20)?;
/// assert_eq!(priorities, [19, 20]);
/// # Ok::<(), tautline_analysis::AnalysisError>(())
/// ```
pub fn audsley(tasks: &[Task], overheads: &Overheads, highest: u8) -> Result<Vec<u8>, AnalysisError> {
    let free: Vec<u8> = (1..=highest).rev().collect();
    audsley_beside(tasks, &[], overheads, &free)
}

/// As [`audsley`], beside tasks whose priorities are `fixed`. Gives the first of the `free` priorities, which descend.
pub(crate) fn audsley_beside(
    tasks: &[Task],
    fixed: &[Task],
    overheads: &Overheads,
    free: &[u8],
) -> Result<Vec<u8>, AnalysisError> {
    let mut waiting = threads(tasks);
    let (levels, highest) = (waiting.len(), u8::try_from(free.len()).unwrap_or(u8::MAX));
    let used = free.get(..levels).ok_or(AnalysisError::TooFewPriorities { levels, highest })?;
    // A task is above all levels until it is placed.
    let open = tasks.iter().map(|task| Task { priority: u8::MAX, ..task.clone() });
    let mut placed: Vec<_> = open.chain(fixed.iter().cloned()).collect();
    Core::new(&placed, overheads)?;
    waiting.sort_by_key(|thread| std::cmp::Reverse(thread.iter().map(|i| tasks[*i].deadline_ns).min()));
    for &level in used.iter().rev() {
        let fits = waiting.iter().position(|thread| {
            thread.iter().for_each(|i| placed[*i].priority = level);
            let meets = |core: &Core, i: usize| {
                core.bound(i).is_ok_and(|bound| bound.nominal_ns <= tasks[i].deadline_ns)
            };
            let fits =
                Core::new(&placed, overheads).is_ok_and(|core| thread.iter().all(|i| meets(&core, *i)));
            if !fits {
                thread.iter().for_each(|i| placed[*i].priority = u8::MAX);
            }
            fits
        });
        match fits {
            Some(position) => drop(waiting.remove(position)),
            None => {
                let names: Vec<_> =
                    waiting.iter().flatten().map(|i| format!("`{}`", tasks[*i].name)).collect();
                return Err(AnalysisError::NoAssignment { tasks: names.join(", ") });
            }
        }
    }
    Ok(placed[..tasks.len()].iter().map(|task| task.priority).collect())
}

fn threads(tasks: &[Task]) -> Vec<Vec<usize>> {
    let mut threads: Vec<Vec<usize>> = Vec::new();
    for (i, task) in tasks.iter().enumerate() {
        let same = |thread: &&mut Vec<usize>| {
            task.group.is_some() && tasks[thread[0]].group.map(|g| g.id) == task.group.map(|g| g.id)
        };
        match threads.iter_mut().find(same) {
            Some(thread) => thread.push(i),
            None => threads.push(vec![i]),
        }
    }
    threads
}

fn shortest_first(tasks: &[Task], time: fn(&Task) -> u64, highest: u8) -> Result<Vec<u8>, AnalysisError> {
    let mut times: Vec<_> = tasks.iter().map(time).collect();
    let threads = threads(tasks);
    for thread in &threads {
        let shortest = thread.iter().map(|i| time(&tasks[*i])).min().unwrap_or(u64::MAX);
        thread.iter().for_each(|i| times[*i] = shortest);
    }
    // Distinct ranks for all threads if they fit, else one for each time.
    let distinct = threads.len() <= usize::from(highest);
    let rank = |thread: usize| if distinct { thread } else { 0 };
    let mut levels: Vec<_> =
        threads.iter().enumerate().map(|(t, thread)| (times[thread[0]], rank(t))).collect();
    levels.sort_unstable();
    levels.dedup();
    if levels.len() > usize::from(highest) {
        return Err(AnalysisError::TooFewPriorities { levels: levels.len(), highest });
    }
    let mut priorities = vec![highest; tasks.len()];
    for (t, thread) in threads.iter().enumerate() {
        let above = levels.partition_point(|level| *level < (times[thread[0]], rank(t)));
        let priority = highest.saturating_sub(u8::try_from(above).unwrap_or(highest));
        thread.iter().for_each(|i| priorities[*i] = priority);
    }
    Ok(priorities)
}
