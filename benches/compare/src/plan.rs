// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is measured, with which systems.

use std::time::Duration;

use clap::ValueEnum;

use crate::modes::{GATEWAY, MODES, Mode, Part, Program, Programs};
use crate::settings::{Extent, Setting, settings};
use crate::{Options, Result};

/// Questions that are asked together, with payloads, rounds and systems of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Bench {
    /// Tautline beside other middleware
    Compare,
    /// The wake-up from one process to another, beside a bare futex and iceoryx2
    Wake,
    /// A request and its response, beside a topic each way, iceoryx2's request-response and r2r's services
    Services,
    /// Topics over two gateways, beside plain Zenoh and hiroz, and what a flood from the network costs local callbacks
    Network,
}

impl Bench {
    /// What it measures.
    fn experiments(self) -> &'static [Experiment] {
        use Experiment::*;
        match self {
            Bench::Compare => &[Latency, OpenLoop, FanOut, Robot, Throughput, StartUp],
            Bench::Wake => &[Latency],
            Bench::Services => &[Request],
            Bench::Network => &[Latency, Window, Throughput, Callbacks],
        }
    }

    /// Whether it measures a way of a system.
    fn has(self, mode: &Mode) -> bool {
        let is_request = matches!(mode.part, Part::Requests | Part::SmallRequests);
        match (self, mode.system, mode.mode) {
            (Bench::Compare, ..) => !is_request,
            (Bench::Services, ..) => is_request,
            (Bench::Wake, "floor", mode) => ["futex", "streaming", "one-core"].contains(&mode),
            (Bench::Wake, "tautline", mode) => {
                ["blocking", "two-cores", "one-core", "busy-poll"].contains(&mode)
            }
            (Bench::Wake, "iceoryx2", mode) => ["waitset", "busy-poll"].contains(&mode),
            (Bench::Network, "tautline", mode) => mode == GATEWAY,
            (Bench::Network, "zenoh", mode) => mode != "shm",
            (Bench::Network, system, _) => system == "hiroz",
            (Bench::Wake, ..) => false,
        }
    }
}

/// A question.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Experiment {
    /// Half round trips by size
    Latency,
    /// One-way times of a topic at 1 kHz, with a quiet machine and under load
    OpenLoop,
    /// One topic of 1 MiB to many subscriptions
    FanOut,
    /// 20 topics at 100 Hz: CPU time, memory, losses
    Robot,
    /// As many messages as go through
    Throughput,
    /// From the start of a process to its first message
    StartUp,
    /// Round trips of a request and its response
    Request,
    /// As many messages as go through with 4 MiB under way
    Window,
    /// Response times of local callbacks while a flood arrives from the network
    Callbacks,
}

/// What the cores may do while they wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Idle {
    /// Sleep, as the machine is set up, unless the system itself decides otherwise.
    AsShipped,
    /// Nothing: `/dev/cpu_dma_latency` is held at 0.
    HeldOff,
}

/// What is done with one system.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Task {
    /// Half round trips.
    RoundTrips {
        /// The payload is written and read whole.
        whole: bool,
    },
    /// One way at a rate over all topics, with a disturbance or without.
    Paced { rate: f64, topics: usize, processes: usize, subscribers: usize, is_loaded: bool, at_once: bool },
    /// Whole round trips of a request and its response.
    Requests,
    /// One way, as fast as the receiver lets it.
    Stream {
        /// The payload is written and read whole.
        whole: bool,
    },
    /// One way, as fast as it goes with [`WINDOW_BYTES`] that are not confirmed.
    Window,
    /// From the start of the sender, or of the receiver, to its messages on all topics.
    Start { topics: usize, is_late_joiner: bool },
}

/// One thing to measure with one system.
#[derive(Clone, Debug)]
pub struct Case {
    pub mode: &'static Mode,
    /// As in the JSON, such as `latency/whole/held-off`.
    pub experiment: String,
    pub task: Task,
    pub payload_bytes: usize,
    pub idle: Idle,
    pub budget: Duration,
    pub rounds: u32,
}

impl Case {
    fn new(mode: &'static Mode, setting: Setting) -> Self {
        let Setting { experiment, task, payload_bytes, idle, budget, rounds } = setting;
        Case { mode, experiment, task, payload_bytes, idle, budget, rounds }
    }

    /// The whole, for messages.
    pub fn name(&self) -> String {
        format!("{}, {}, {} B", self.mode.name(), self.experiment, self.payload_bytes)
    }
}

/// Bytes of a stream that may be under way.
pub const WINDOW_BYTES: usize = 4 << 20;

/// Experiments and their payloads, whatever is chosen of them, but for callbacks.
#[cfg(test)]
pub fn measurable() -> std::collections::BTreeSet<(String, usize)> {
    let extents = [Extent::Smoke, Extent::Quick, Extent::Full];
    let all = Bench::value_variants().iter().flat_map(|bench| extents.map(|extent| settings(*bench, extent)));
    all.flatten().map(|setting| (setting.experiment, setting.payload_bytes)).collect()
}

/// Everything that is measured.
pub struct Plan {
    pub bench: Bench,
    pub realtime: bool,
    /// The sender's and the receiver's.
    pub cores: [usize; 2],
    /// Whether their threads stay there.
    pub is_pinned: bool,
    pub cases: Vec<Case>,
    /// The most rounds of a case.
    pub rounds: u32,
    /// Rounds of the experiment with callbacks, and the length of each in seconds.
    pub callbacks: (u32, u64),
    pub programs: Programs,
    /// Modes that would have taken part, and why they do not.
    pub missing: Vec<(&'static Mode, String)>,
    /// Those asked for; none: all.
    pub systems: Vec<String>,
    pub extent: Extent,
}

impl Plan {
    pub fn new(options: &Options, cores: [usize; 2], programs: Programs) -> Result<Self> {
        let extent = match options {
            Options { smoke: true, .. } => Extent::Smoke,
            Options { quick: true, .. } => Extent::Quick,
            _ => Extent::Full,
        };
        let bench = options.bench;
        let is_wanted = |mode: &&Mode| bench.has(mode) && is_among(&options.systems, mode.system);
        let (mut modes, mut missing) = (Vec::new(), Vec::new());
        for mode in MODES.iter().filter(is_wanted) {
            let program = match mode.program {
                Program::Own => Ok(()),
                Program::Gateways => programs.find(GATEWAY).map(drop),
                Program::Json(name) => programs.find(name).map(drop),
                Program::Daemon(name, daemon) => programs.find(name).and(programs.find(daemon)).map(drop),
            };
            match program {
                Ok(()) => modes.push(mode),
                Err(reason) => missing.push((mode, reason)),
            }
        }
        let has = |experiment: &&Experiment| bench.experiments().contains(experiment);
        if let Some(&other) = options.only.iter().find(|experiment| !has(experiment)) {
            let names: Vec<String> = bench.experiments().iter().map(|it| value(*it)).collect();
            let (other, names) = (value(other), names.join(", "));
            return Err(format!("--only {other}: this bench does not measure it, but {names}").into());
        }
        let chosen = if options.only.is_empty() { bench.experiments() } else { &options.only };
        let settings = settings(bench, extent);
        let of_experiment = |experiment: &Experiment| {
            let kind = value(*experiment);
            settings.iter().filter(move |setting| setting.experiment.split('/').next() == Some(kind.as_str()))
        };
        let of_setting = |setting: &Setting| {
            let modes = modes.iter().filter(|mode| takes_part(bench, mode, setting));
            modes.map(|mode| Case::new(mode, setting.clone())).collect::<Vec<_>>()
        };
        let mut cases: Vec<Case> = chosen.iter().flat_map(of_experiment).flat_map(of_setting).collect();
        let gateway = is_among(&options.systems, "tautline") && chosen.contains(&Experiment::Callbacks);
        let mut callbacks = match extent {
            Extent::Smoke => (1, 2),
            Extent::Quick => (1, 4),
            Extent::Full => (5, 10),
        };
        if let Some(rounds) = options.rounds {
            cases.iter_mut().for_each(|case| case.rounds = rounds);
            callbacks.0 = rounds;
        }
        if !gateway {
            callbacks = (0, 0);
        }
        if cases.is_empty() && callbacks.0 == 0 && missing.is_empty() {
            let systems = options.systems.join(", ");
            return Err(format!("--systems {systems}: none of them takes part in this bench").into());
        }
        let rounds = cases.iter().map(|case| case.rounds).max().unwrap_or(0);
        let systems = options.systems.clone();
        Ok(Plan {
            bench,
            realtime: !options.no_rt,
            cores,
            is_pinned: !options.no_cores,
            cases,
            rounds,
            callbacks,
            programs,
            missing,
            systems,
            extent,
        })
    }

    /// Where a thread is to stay.
    pub fn pin(&self, core: usize) -> Option<usize> {
        self.is_pinned.then_some(core)
    }

    /// Whether a system was asked for.
    pub fn is_wanted(&self, system: &str) -> bool {
        is_among(&self.systems, system)
    }

    /// How many measurements there will be.
    pub fn runs(&self) -> u64 {
        self.cases.iter().map(|case| u64::from(case.rounds)).sum()
    }
}

/// An experiment as it is written on the command line.
fn value(experiment: Experiment) -> String {
    experiment.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default()
}

fn is_among(systems: &[String], system: &str) -> bool {
    systems.is_empty() || systems.iter().any(|name| name == system)
}

fn takes_part(bench: Bench, mode: &Mode, setting: &Setting) -> bool {
    match (mode.part, setting.task) {
        // Of whom no other holds its sender back without a window.
        (_, Task::Stream { .. }) if bench == Bench::Network => mode.system == "zenoh",
        (_, Task::RoundTrips { .. } | Task::Window) if bench == Bench::Network => true,
        (Part::All, _) => true,
        (Part::RoundTrips, Task::RoundTrips { .. }) => true,
        (Part::AsShipped, Task::RoundTrips { .. }) => setting.idle == Idle::AsShipped,
        (Part::Small, Task::RoundTrips { .. }) => setting.payload_bytes == 64,
        (Part::Topics | Part::Flows, Task::Paced { topics, .. }) => topics > 1,
        (Part::Flows, Task::Stream { .. }) => true,
        (Part::Copy, Task::RoundTrips { whole }) => whole && setting.idle == Idle::HeldOff,
        (Part::Whole, Task::RoundTrips { whole }) => whole,
        (Part::Requests, Task::Requests) => true,
        (Part::SmallRequests, Task::Requests) => setting.payload_bytes == 64,
        _ => false,
    }
}
