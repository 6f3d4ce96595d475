// SPDX-License-Identifier: MIT OR Apache-2.0
//! A small simulator of a core from the critical instant on, for pictures and for tests of the bounds.
use std::cmp::Reverse;

use crate::{Order, Overheads, Rank, Task};

/// Time that one job spent on the core without a break.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// Index of the task; `None` for overhead: messages and timer ticks.
    pub task: Option<usize>,
    /// When it began, in nanoseconds after the critical instant.
    pub start_ns: u64,
    /// When it stopped.
    pub end_ns: u64,
}

/// One job, from its release to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Job {
    /// Index of the task.
    pub task: usize,
    /// When it was ready, in nanoseconds after the critical instant; its nominal release may lie before.
    pub release_ns: u64,
    /// When it ended; `None` if the simulation was over before.
    pub end_ns: Option<u64>,
}

/// The course of events after a critical instant.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Timeline {
    /// The jobs that had the core, in order.
    pub runs: Vec<Run>,
    /// All jobs, in the order of their release.
    pub jobs: Vec<Job>,
}

struct Ready {
    /// Place in [`Timeline::jobs`]; `None` for overhead.
    job: Option<usize>,
    task: Option<usize>,
    /// Priority, and whether it may not be preempted once it has begun.
    rank: (bool, u16),
    /// The order among equal priorities.
    turn: (u64, usize),
    non_preemptive: bool,
    work_ns: u64,
    /// Its thread, if that goes by ranks: it runs one job after the other.
    thread: Option<u32>,
    has_begun: bool,
    /// The priority to which its thread lowers itself when this much work is left.
    lowered: Option<(u16, u64)>,
}

/// Runs the tasks of one core for a while: all are released at once, as late as their jitter allows, then as soon as
/// their curves allow, each job takes its wcet, and overheads take theirs. Blocking and throttling are left out. In a
/// thread without order, the last task goes first, its own jobs in their order.
///
/// Zero periods are left out. At most 1,000,000 jobs are simulated.
pub fn critical_instant(tasks: &[Task], overheads: &Overheads, until_ns: u64) -> Timeline {
    let mut releases = releases(tasks, overheads, until_ns);
    releases.reverse();
    let mut timeline = Timeline::default();
    let mut ready: Vec<Ready> = Vec::new();
    let mut now = 0;
    while now < until_ns {
        while let Some((_, task, message)) = releases.pop_if(|(at, ..)| *at <= now) {
            ready.push(admit(&mut timeline, tasks, overheads, now, task, message));
        }
        let next = releases.last().map_or(until_ns, |(at, ..)| *at);
        let is_busy = |of: &Ready| {
            let other = |other: &Ready| other.has_begun && other.thread == of.thread;
            of.thread.is_some() && !of.has_begun && ready.iter().any(other)
        };
        let free = (0..ready.len()).filter(|i| !is_busy(&ready[*i]));
        let Some(i) = free.max_by_key(|i| (ready[*i].rank, Reverse(ready[*i].turn))) else {
            now = next;
            continue;
        };
        let running = &mut ready[i];
        running.rank.0 |= running.non_preemptive;
        running.has_begun = true;
        let left_ns = running.lowered.map_or(0, |(_, left_ns)| left_ns);
        let end = now.saturating_add(running.work_ns - left_ns).min(next);
        running.work_ns -= end - now;
        if let Some((priority, _)) = running.lowered.take_if(|(_, left_ns)| running.work_ns == *left_ns) {
            running.rank.1 = priority;
        }
        let task = running.task;
        match timeline.runs.last_mut() {
            Some(run) if run.task == task && run.end_ns == now => run.end_ns = end,
            _ => timeline.runs.push(Run { task, start_ns: now, end_ns: end }),
        }
        now = end;
        if ready[i].work_ns == 0 {
            let done = ready.swap_remove(i);
            if let Some(job) = done.job {
                timeline.jobs[job].end_ns = Some(now);
            }
        }
    }
    timeline.runs.retain(|run| run.end_ns > run.start_ns);
    timeline
}

/// (time, task, whether it is the overhead of the message or tick instead of the job), by time.
fn releases(tasks: &[Task], overheads: &Overheads, until_ns: u64) -> Vec<(u64, Option<usize>, bool)> {
    let mut releases = Vec::new();
    for (i, task) in tasks.iter().enumerate().filter(|(_, task)| task.period_ns > 0) {
        let release = task.release();
        let instants = (0..).map(|k| release.shortest_span(k)).take_while(|at| *at < until_ns);
        releases.extend(
            instants.take(1_000_000 / tasks.len()).flat_map(|at| [(at, Some(i), true), (at, Some(i), false)]),
        );
    }
    if overheads.tick_period_ns > 0 {
        let ticks = (0..until_ns.div_ceil(overheads.tick_period_ns)).take(1_000_000);
        releases.extend(ticks.map(|k| (k * overheads.tick_period_ns, None, true)));
    }
    releases.sort_by_key(|(at, ..)| *at);
    releases
}

fn admit(
    timeline: &mut Timeline,
    tasks: &[Task],
    overheads: &Overheads,
    now: u64,
    index: Option<usize>,
    overhead: bool,
) -> Ready {
    let task = index.map(|i| &tasks[i]);
    let Some((i, task)) = index.zip(task).filter(|_| !overhead) else {
        let message = |task: &Task| task.message_overhead_ns.unwrap_or(overheads.per_message_ns);
        let (work_ns, rank) = (task.map_or(overheads.tick_ns, message), (false, u16::MAX));
        return Ready {
            job: None,
            task: None,
            rank,
            turn: (0, 0),
            non_preemptive: false,
            work_ns,
            thread: None,
            has_begun: false,
            lowered: None,
        };
    };
    timeline.jobs.push(Job { task: i, release_ns: now, end_ns: None });
    let job = timeline.jobs.len() - 1;
    let turn = match task.group.map(|group| group.order) {
        Some(Order::Any) => ((tasks.len() - i) as u64, job),
        Some(Order::Priority) => match task.rank {
            Rank::Timer { .. } => (0, job),
            Rank::Of(rank) => (1 + u64::from(u8::MAX - rank), job),
        },
        _ => (now, job),
    };
    let work_ns = task.charged_ns(overheads);
    let is_lowered = !task.rank.is_timer() && task.lowest() < task.priority;
    let left_ns = work_ns.saturating_sub(task.waits_ns(overheads));
    Ready {
        job: Some(job),
        task: Some(i),
        rank: (false, task.priority.into()),
        turn,
        non_preemptive: task.non_preemptive_ns >= task.wcet_ns,
        work_ns,
        thread: task.group.filter(|group| group.order == Order::Priority).map(|group| group.id),
        has_begun: false,
        lowered: is_lowered.then(|| (task.lowest().into(), left_ns)),
    }
}
