// SPDX-License-Identifier: MIT OR Apache-2.0
//! The topics of both experiments, from the files that `taut check` reads.

use tautline_analysis::file::{CheckedCallback, SystemFile};
use tautline_paper::Topic;

use crate::Result;

const PAPER: &str = include_str!("../../../../examples/systems/paper.toml");
const CAPACITY: &str = include_str!("../../../../examples/systems/capacity.toml");

/// The paper keeps the last 100 messages: more than any variant needs.
const DEPTH: usize = 100;

/// A set of topics with what the analysis says of them on a machine that costs nothing.
#[derive(Clone, Debug)]
pub struct Application {
    pub topics: Vec<Topic>,
    /// Response times of the classical analysis; `None` without a bound.
    pub rta_ns: Vec<Option<u64>>,
}

pub fn paper() -> Result<Application> {
    application(PAPER, |_| Some(DEPTH))
}

/// The capacity experiment: a queue that, as computed, must hold more than r2r's channels do.
#[derive(Clone, Debug)]
pub struct Capacity {
    /// Each topic's queue is as deep as the analysis says.
    pub application: Application,
    /// Which of its topics has the deep queue: the one of the lowest priority.
    pub deep: usize,
}

pub fn capacity() -> Result<Capacity> {
    let application = application(CAPACITY, |callback| callback.capacity)?;
    let lowest = application.topics.iter().enumerate().min_by_key(|(_, topic)| topic.priority);
    let deep = lowest.ok_or("the system has no callbacks")?.0;
    Ok(Capacity { application, deep })
}

/// The callbacks of a file, with queues of this depth.
fn application(file: &str, depth: fn(&CheckedCallback) -> Option<usize>) -> Result<Application> {
    let callbacks = SystemFile::parse(file)?.check().callbacks;
    let topic = |callback: &CheckedCallback| {
        let name = callback.entry.topics.first().unwrap_or(&callback.entry.name);
        Ok(Topic {
            name: name.clone(),
            period_ns: callback.period_ns,
            wcet_ns: callback.wcet_ns,
            priority: callback.entry.priority,
            deadline_ns: callback.entry.deadline_ns,
            depth: depth(callback).ok_or_else(|| format!("{name} has no bound"))?,
        })
    };
    let rta_ns = callbacks.iter().map(|callback| callback.response_ns).collect();
    Ok(Application { topics: callbacks.iter().map(topic).collect::<Result<_>>()?, rta_ns })
}

impl Capacity {
    pub fn computed(&self) -> usize {
        self.application.topics[self.deep].depth
    }

    /// The topics, the deep queue having `depth` places.
    pub fn topics(&self, depth: usize) -> Vec<Topic> {
        let mut topics = self.application.topics.clone();
        topics[self.deep].depth = depth;
        topics
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_table_and_its_response_times() {
        let paper = paper().unwrap();
        let ms = |ns: u64| ns / 1_000_000;
        let rows: Vec<_> = paper
            .topics
            .iter()
            .map(|t| (ms(t.period_ns), ms(t.wcet_ns), t.priority, ms(t.deadline_ns)))
            .collect();
        let expected =
            [(10, 2, 20, 10), (20, 4, 19, 20), (50, 5, 18, 50), (100, 15, 17, 100), (200, 50, 16, 200)];
        assert_eq!(rows, expected);
        assert_eq!(paper.rta_ns, [2, 6, 13, 36, 170].map(|ms| Some(ms * 1_000_000)));
        assert_eq!(paper.topics[0].name, "topic1");
    }

    #[test]
    fn one_queue_must_be_deeper_than_r2rs_channels() {
        let capacity = capacity().unwrap();
        assert_eq!((capacity.deep, capacity.computed()), (1, 16));
        let depths = |depth| capacity.topics(depth).iter().map(|topic| topic.depth).collect::<Vec<_>>();
        assert_eq!((depths(16), depths(15)), (vec![1, 16], vec![1, 15]));
        // What comes while the planner computes, counted by hand: at 0, 5, ..., 75 ms.
        let topics = capacity.topics(16);
        assert_eq!(topics[0].wcet_ns / topics[1].period_ns + 1, 16);
    }
}
