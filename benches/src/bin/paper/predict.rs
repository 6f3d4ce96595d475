// SPDX-License-Identifier: MIT OR Apache-2.0
//! Response times computed, with what middleware and machine were seen to cost.

use std::time::Duration;

use tautline_analysis::{Overheads, Task, response_time_per_task};
use tautline_paper::Topic;
use tautline_rt::Interruptions;

/// The topics' response times if each message costs `per_message_ns` at the highest priority and the machine takes what it
/// was seen to take: its regular interruptions as a task above all others, the longest regular one as blocking.
pub fn response_times_ns(
    topics: &[Topic],
    per_message_ns: u64,
    interruptions: &Interruptions,
) -> Vec<Option<u64>> {
    let blocking = Duration::from_nanos(interruptions.regular_ns);
    let task = |topic: &Topic| {
        let task = Task::new(topic.name.as_str(), topic.period(), topic.wcet(), topic.priority);
        task.deadline(Duration::from_nanos(topic.deadline_ns)).blocking(blocking)
    };
    let mut tasks: Vec<_> = topics.iter().map(task).collect();
    if let (Some(period_ns), Some(work_ns)) = (interruptions.period_ns(), interruptions.mean_ns()) {
        let (period, work) = (Duration::from_nanos(period_ns), Duration::from_nanos(work_ns));
        tasks.push(Task::new("interrupts", period, work, u8::MAX).message_overhead(Duration::ZERO));
    }
    let overheads = Overheads { per_message_ns, ..Overheads::NONE };
    let outcomes = response_time_per_task(&tasks, &overheads).into_iter().take(topics.len());
    outcomes.map(|outcome| outcome.ok().map(|response| response.response_ns)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_overhead_table_of_the_papers_set() {
        let topics = crate::application::paper().unwrap().topics;
        let us = |per_message_us: u64| {
            let bounds = response_times_ns(&topics, per_message_us * 1_000, &Interruptions::default());
            bounds.into_iter().map(|bound| bound.unwrap() / 1_000).collect::<Vec<_>>()
        };
        assert_eq!(us(0), [2_000, 6_000, 13_000, 36_000, 170_000]);
        assert_eq!(us(15), [2_075, 6_075, 13_090, 36_135, 172_510]);
        assert_eq!(us(60), [2_300, 6_300, 13_360, 36_540, 174_040]);
    }

    #[test]
    fn what_the_machine_takes_delays_everything() {
        let topics = crate::application::paper().unwrap().topics;
        let seen = Interruptions {
            window_ns: 1_000_000_000,
            count: 1_000,
            total_ns: 5_000_000,
            regular_ns: 20_000,
            longest_ns: 9_000_000,
        };
        let bounds = response_times_ns(&topics, 0, &seen);
        // Three interruptions of 5 µs fall into 2 ms, and one of 20 µs blocks.
        assert_eq!(bounds[0], Some(2_000_000 + 20_000 + 3 * 5_000));
    }
}
