// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a process is told, as JSON on its command line, and what it says: lines of JSON on standard output.

use crate::process::Process;
use crate::{Bench, Result, population, storm, topics, traffic};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;
use tautline_exchange::{say, until_told};
use tautline_rt::clock::monotonic_ns;

/// The domain of all processes, in a scope of their own.
pub const DOMAIN: u32 = 0;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Job {
    /// Have a node as every ROS 2 process has, until standard input is closed.
    Node {
        index: usize,
        /// Wait here before.
        gate: Option<PathBuf>,
        /// Say when it is matched with so many processes, this one included.
        processes: Option<usize>,
    },
    /// Have so many publishers and as many subscriptions, each of a topic of its own.
    Ports {
        index: usize,
        pairs: usize,
    },
    /// Send back when what came was taken.
    Echo,
    /// Look at a domain with so many processes that have a node, and make ports in it.
    Probe {
        processes: usize,
        quick: bool,
    },
    Look {
        quick: bool,
    },
    Listen {
        topics: usize,
    },
    Talk {
        topics: usize,
        quick: bool,
    },
    /// Have so many nodes as rclcpp makes them.
    Nodes {
        nodes: usize,
    },
    /// Have ends of one topic, until all of it are matched.
    Crowd {
        publishers: usize,
        subscriptions: usize,
        of: usize,
        gate: PathBuf,
    },
    Flow {
        system: String,
        job: tautline_exchange::Job,
    },
}

#[derive(Debug, Serialize, Deserialize)]
pub enum Said {
    /// It has made what it was to make, in so many nanoseconds.
    Made { ns: u64 },
    /// All its ends were matched at this time (`CLOCK_MONOTONIC`).
    Matched { at_ns: u64 },
    /// Times of several kinds, in nanoseconds, and how often each occurred.
    Times(Vec<(String, Vec<(u64, u64)>)>),
}

impl Job {
    pub fn run(text: &str) -> Result<()> {
        match serde_json::from_str(text)? {
            Job::Node { index, gate, processes } => population::node(index, gate, processes),
            Job::Ports { index, pairs } => population::ports(index, pairs),
            Job::Echo => population::echo(),
            Job::Probe { processes, quick } => population::probe(processes, quick),
            Job::Look { quick } => population::look(quick),
            Job::Listen { topics } => topics::listen(topics),
            Job::Talk { topics, quick } => topics::talk(topics, quick),
            Job::Nodes { nodes } => storm::nodes(nodes),
            Job::Crowd { publishers, subscriptions, of, gate } => {
                storm::join_crowd(publishers, subscriptions, of, &gate)
            }
            Job::Flow { system, job } => traffic::run(&system, &job),
        }
    }

    fn name(&self) -> String {
        let text = format!("{self:?}");
        text.split([' ', '{']).next().unwrap_or_default().to_lowercase()
    }
}

impl<'a> Bench<'a> {
    /// Starts a process for a job; `L` is what it says.
    pub fn start<L: serde::de::DeserializeOwned + Send + 'static>(
        &self,
        job: &Job,
    ) -> Result<Process<'a, L>> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("--child").arg(serde_json::to_string(job)?);
        Process::start(&mut command, format!("process '{}'", job.name()), self.interrupted)
    }
}

/// Says something, and stays until the process that started this one closes its standard input.
pub fn say_and_stay(said: &Said) -> Result<()> {
    say(said);
    until_told();
    Ok(())
}

/// Looks until it is so, with a rest after each look.
pub fn wait_until(
    what: &str,
    patience: Duration,
    rest: impl Fn(),
    mut is_so: impl FnMut() -> Result<bool>,
) -> Result<()> {
    let end_ns = monotonic_ns() + patience.as_nanos() as u64;
    while !is_so()? {
        if monotonic_ns() > end_ns {
            return Err(format!("{} s were not enough until {what}", patience.as_secs()).into());
        }
        rest();
    }
    Ok(())
}
