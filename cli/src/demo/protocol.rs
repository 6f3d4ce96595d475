// SPDX-License-Identifier: MIT OR Apache-2.0
//! The messages of the demo's child processes: lines of JSON on standard output. Their parent ends them by closing their
//! standard input.

use super::application::Collected;
use serde::{Deserialize, Serialize};
use std::io::{BufRead, BufReader, Read, Write};
use std::sync::mpsc;
use tautline::Context;
use tautline_rt::clock::process_cpu_ns;

#[derive(Serialize, Deserialize, Debug)]
pub enum Line {
    /// Set up; the publisher may start.
    Ready,
    /// Messages released or handled so far.
    Progress(u64),
    /// The end of the publisher.
    Published(Published),
    /// The end of the subscriber.
    Measured(Measured),
}

/// The publisher's result.
#[derive(Serialize, Deserialize, Debug, Default)]
pub struct Published {
    pub messages: u64,
    /// CPU time for these messages, in nanoseconds.
    pub cpu_ns: u64,
    /// Releases that came too late to be published.
    pub missed: u64,
    /// The time that was taken from the core, as measured by the process's threads.
    pub seen: Collected,
}

/// The subscriber's measurements.
#[derive(Serialize, Deserialize, Debug, Default)]
pub struct Measured {
    /// CPU time of the process beyond the callbacks' own, in nanoseconds.
    pub overhead_cpu_ns: u64,
    pub topics: Vec<TopicMeasured>,
    /// The time that was taken from the core, as measured by the process's threads.
    pub seen: Collected,
}

/// One call of a topic's callback.
#[derive(Serialize, Deserialize, Debug, Clone, Copy, PartialEq, Eq)]
pub struct Job {
    /// The scheduled release, in ns of `CLOCK_MONOTONIC`.
    pub release_ns: u64,
    /// The time from which the thread was ready to run.
    pub ready_ns: u64,
    pub begin_ns: u64,
    pub end_ns: u64,
    /// How long the thread waited for the core from `ready_ns` to `end_ns`.
    pub waited_ns: u64,
}

impl Job {
    /// From the release to the end.
    pub fn latency_ns(&self) -> u64 {
        self.end_ns.saturating_sub(self.release_ns)
    }
}

#[derive(Serialize, Deserialize, Debug, Default)]
pub struct TopicMeasured {
    pub jobs: Vec<Job>,
    pub lost: u64,
    pub max_queue: u64,
}

/// Writes a line to standard output. If that fails, the parent has died, and standard input is closed as well.
pub fn say(line: &Line) {
    if let Ok(text) = serde_json::to_string(line) {
        let mut out = std::io::stdout().lock();
        let _ = writeln!(out, "{text}").and_then(|()| out.flush());
    }
}

/// Says that this process is ready, and spins until the context is shut down, at the latest when standard input is closed. Returns the
/// processor time of the process meanwhile, in nanoseconds.
pub fn spin(context: &Context) -> Result<u64, tautline::Error> {
    let ended = context.clone();
    // An ordinary thread that sleeps until then.
    std::thread::spawn(move || {
        let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
        ended.shutdown();
    });
    let before_ns = process_cpu_ns();
    say(&Line::Ready);
    context.spin()?;
    Ok(process_cpu_ns() - before_ns)
}

/// The lines of a process, as they come; ends with the process.
pub fn listen(output: impl Read + Send + 'static) -> mpsc::Receiver<Line> {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        for text in BufReader::new(output).lines().map_while(Result::ok) {
            if let Ok(line) = serde_json::from_str(&text)
                && sender.send(line).is_err()
            {
                return;
            }
        }
    });
    receiver
}
