// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's job, as JSON on its command line, and its output: lines of JSON on standard output.

use crate::process::Process;
use crate::traffic::System;
use crate::{Bench, Result, population, storm, topics, traffic};
use serde::{Deserialize, Serialize};
use std::io::{Read, Write, stdin, stdout};
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;
use tautline_rt::clock::monotonic_ns;

/// The domain of all processes, in a scope of their own.
pub const DOMAIN: u32 = 0;

/// A process's job.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Job {
    /// Create a node with the endpoints of every ROS 2 process, until standard input is closed.
    Node {
        index: usize,
        /// Wait here first.
        gate: Option<PathBuf>,
        /// Report when it is matched with this many processes, itself included.
        processes: Option<usize>,
    },
    /// Create this many publishers and as many subscriptions, each with its own topic.
    Ports { index: usize, pairs: usize },
    /// Send back when each message was taken.
    Echo,
    /// Read the graph of a domain with this many processes with a node, and create ports in it.
    Probe { processes: usize, quick: bool },
    /// Only read the graph.
    Look { quick: bool },
    /// Subscribe to this many topics.
    Listen { topics: usize },
    /// Publish on this many topics.
    Talk { topics: usize, quick: bool },
    /// Create this many nodes, as rclcpp does.
    Nodes { nodes: usize },
    /// Create endpoints of one topic, until all are matched.
    Crowd { publishers: usize, subscriptions: usize, of: usize, gate: PathBuf },
    /// Send or receive at a rate.
    Flow { system: System, job: tautline_exchange::Job },
}

/// A process's output.
#[derive(Debug, Serialize, Deserialize)]
pub enum Said {
    /// It has finished creating, after this many nanoseconds.
    Made { ns: u64 },
    /// All its endpoints were matched at this time (`CLOCK_MONOTONIC`).
    Matched { at_ns: u64 },
    /// Times of several kinds, in nanoseconds, with their counts.
    Times(Vec<(String, Vec<(u64, u64)>)>),
}

impl Job {
    /// Runs the job, in the child process.
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
            Job::Flow { system, job } => traffic::run(system, &job),
        }
    }

    fn name(&self) -> String {
        let text = format!("{self:?}");
        text.split([' ', '{']).next().unwrap_or_default().to_lowercase()
    }
}

impl<'a> Bench<'a> {
    /// Starts a process for a job with output `L`.
    pub fn start<L: serde::de::DeserializeOwned + Send + 'static>(
        &self,
        job: &Job,
    ) -> Result<Process<'a, L>> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("--child").arg(serde_json::to_string(job)?);
        Process::start(&mut command, format!("process '{}'", job.name()), self.interrupted)
    }
}

/// Sends a line to the parent process.
pub fn say(said: &Said) -> Result<()> {
    let mut out = stdout().lock();
    writeln!(out, "{}", serde_json::to_string(said)?)?;
    Ok(out.flush()?)
}

/// Polls a condition, with a pause after each check.
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

/// Waits until the parent closes standard input.
pub fn wait_for_end() {
    // An error also ends the wait.
    let _ = stdin().read_to_end(&mut Vec::new());
}
