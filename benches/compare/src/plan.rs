// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is measured.

use std::collections::BTreeSet;
use std::time::Duration;

use clap::ValueEnum;

use crate::modes::{GATEWAY, MODES, Mode, Part, Program, Programs};
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
            (Bench::Wake, "floor", mode) => ["futex", "one-core"].contains(&mode),
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
#[derive(Clone, Copy, Debug)]
pub struct Case {
    pub experiment: Experiment,
    pub task: Task,
    pub mode: &'static Mode,
    pub payload_bytes: usize,
    pub idle: Idle,
    pub budget: Duration,
    pub rounds: u32,
}

impl Case {
    /// The experiment with its settings, as in the JSON.
    pub fn experiment(&self) -> String {
        name(self.experiment, self.task, self.idle)
    }

    /// The whole, for messages.
    pub fn name(&self) -> String {
        format!("{} {}, {}, {} B", self.mode.system, self.mode.mode, self.experiment(), self.payload_bytes)
    }
}

/// Bytes of a stream that may be under way.
pub const WINDOW_BYTES: usize = 4 << 20;

/// Callbacks, without and with a flood.
pub const QUIET: &str = "callbacks/quiet";
pub const FLOOD: &str = "callbacks/flood";

fn name(experiment: Experiment, task: Task, idle: Idle) -> String {
    let idle = match idle {
        Idle::AsShipped => "as-shipped",
        Idle::HeldOff => "held-off",
    };
    match task {
        Task::RoundTrips { whole } => {
            format!("latency/{}/{idle}", if whole { "whole" } else { "untouched" })
        }
        Task::Paced { is_loaded, .. } if experiment == Experiment::OpenLoop => {
            format!("open-loop/{}/{idle}", if is_loaded { "load" } else { "quiet" })
        }
        Task::Paced { processes, subscribers, .. } if experiment == Experiment::FanOut => match processes {
            1 => format!("fan-out/one-process/{idle}/{subscribers}"),
            _ => format!("fan-out/processes/{idle}/{processes}"),
        },
        Task::Paced { rate, topics, at_once, .. } => {
            let how = if at_once { "/at-once" } else { "" };
            format!("robot/{topics}x{}Hz{how}/{idle}", rate / topics as f64)
        }
        Task::Requests => format!("request/{idle}"),
        Task::Stream { whole: true } => format!("throughput/{idle}"),
        Task::Stream { whole: false } => format!("throughput/untouched/{idle}"),
        Task::Window => format!("window/{idle}"),
        Task::Start { is_late_joiner: true, .. } => format!("start-up/late-joiner/{idle}"),
        Task::Start { topics: 1, .. } => format!("start-up/first-message/{idle}"),
        Task::Start { topics, .. } => format!("start-up/{topics}-topics/{idle}"),
    }
}

/// The names of all experiments, whatever is chosen of them.
pub fn experiments() -> BTreeSet<String> {
    let mut names: BTreeSet<String> = [QUIET, FLOOD].map(str::to_owned).into();
    for bench in Bench::value_variants() {
        for &experiment in bench.experiments() {
            for extent in [Extent::Smoke, Extent::Quick, Extent::Full] {
                let settings = settings(*bench, experiment, extent).into_iter();
                names.extend(settings.map(|setting| name(experiment, setting.task, setting.idle)));
            }
        }
    }
    names
}

/// Everything that is measured.
pub struct Plan {
    pub bench: Bench,
    pub realtime: bool,
    /// The sender's and the receiver's.
    pub cores: [usize; 2],
    pub cases: Vec<Case>,
    /// The most rounds of a case.
    pub rounds: u32,
    /// Rounds of the experiment with callbacks, and the length of each in seconds.
    pub callbacks: (u32, u64),
    pub programs: Programs,
    /// Modes that would have taken part, and why they do not.
    pub missing: Vec<(&'static Mode, String)>,
    /// Those asked for; none: all.
    systems: Vec<String>,
    pub quick: bool,
}

/// How much of it.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Extent {
    Smoke,
    Quick,
    Full,
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
        let experiments = bench.experiments().iter();
        let chosen: Vec<Experiment> = experiments
            .filter(|experiment| options.only.is_empty() || options.only.contains(experiment))
            .copied()
            .collect();
        if chosen.is_empty() {
            let names: Vec<String> = bench.experiments().iter().map(|it| value(*it)).collect();
            return Err(format!("--only: this bench has {}", names.join(", ")).into());
        }
        let mut cases = Vec::new();
        for &experiment in &chosen {
            cases.extend(of_experiment(bench, experiment, extent, &modes));
        }
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
        let rounds = cases.iter().map(|case| case.rounds).max().unwrap_or(0);
        let quick = extent != Extent::Full;
        let systems = options.systems.clone();
        Ok(Plan {
            bench,
            realtime: !options.no_rt,
            cores,
            cases,
            rounds,
            callbacks,
            programs,
            missing,
            systems,
            quick,
        })
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

/// One setting of an experiment, for every mode that takes part.
#[derive(Clone, Copy)]
struct Setting {
    task: Task,
    payload_bytes: usize,
    idle: Idle,
    budget_ms: u64,
    rounds: u32,
}

fn settings(bench: Bench, experiment: Experiment, extent: Extent) -> Vec<Setting> {
    match (bench, experiment) {
        (Bench::Wake, _) => wake(extent),
        (Bench::Network, Experiment::Latency) => over_gateways(extent),
        (_, Experiment::Latency) => latency(extent),
        (_, Experiment::OpenLoop) => open_loop(extent),
        (_, Experiment::FanOut) => fan_out(extent),
        (_, Experiment::Robot) => robot(extent),
        (Bench::Network, Experiment::Throughput) => streams(Task::Stream { whole: false }, extent),
        (_, Experiment::Throughput) => throughput(extent),
        (_, Experiment::StartUp) => start_up(extent),
        (_, Experiment::Request) => requests(extent),
        (_, Experiment::Window) => streams(Task::Window, extent),
        // Of which the ends are none of the systems': see `callbacks`.
        (_, Experiment::Callbacks) => Vec::new(),
    }
}

fn of_experiment(bench: Bench, experiment: Experiment, extent: Extent, modes: &[&'static Mode]) -> Vec<Case> {
    let case = |setting: &Setting, mode| Case {
        experiment,
        task: setting.task,
        mode,
        payload_bytes: setting.payload_bytes,
        idle: setting.idle,
        budget: Duration::from_millis(setting.budget_ms),
        rounds: setting.rounds,
    };
    let of_setting = |setting: &Setting| -> Vec<Case> {
        let modes = modes.iter().filter(|mode| takes_part(bench, mode, setting));
        modes.map(|mode| case(setting, mode)).collect()
    };
    settings(bench, experiment, extent).iter().flat_map(of_setting).collect()
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
        (Part::Topics, Task::Paced { topics, .. }) => topics > 1,
        (Part::Copy, Task::RoundTrips { whole }) => whole && setting.idle == Idle::HeldOff,
        (Part::Whole, Task::RoundTrips { whole }) => whole,
        (Part::Requests, Task::Requests) => true,
        (Part::SmallRequests, Task::Requests) => setting.payload_bytes == 64,
        _ => false,
    }
}

/// Each size untouched and whole, with both idle states.
fn wake(extent: Extent) -> Vec<Setting> {
    let both = |bytes| [(bytes, false), (bytes, true)];
    let (payloads, budget_ms, rounds) = match extent {
        Extent::Smoke => (vec![(64, false), (1 << 20, true)], 60, 1),
        Extent::Quick => (vec![(64, false), (1 << 20, true), (8 << 20, false)], 150, 3),
        Extent::Full => ([64, 4 << 10, 1 << 20, 8 << 20].map(both).concat(), 200, 5),
    };
    let mut settings = Vec::new();
    for idle in [Idle::AsShipped, Idle::HeldOff] {
        for &(payload_bytes, whole) in &payloads {
            settings.push(Setting {
                task: Task::RoundTrips { whole },
                payload_bytes,
                idle,
                budget_ms,
                rounds,
            });
        }
    }
    settings
}

fn requests(extent: Extent) -> Vec<Setting> {
    let (budget_ms, rounds) = match extent {
        Extent::Smoke => (60, 1),
        Extent::Quick => (200, 3),
        Extent::Full => (1000, 7),
    };
    let setting = |payload_bytes| Setting {
        task: Task::Requests,
        payload_bytes,
        idle: Idle::HeldOff,
        budget_ms,
        rounds,
    };
    [64, 4 << 10, 1 << 20].map(setting).into()
}

fn of_network(task: Task, sizes: &[usize], extent: Extent) -> Vec<Setting> {
    let (budget_ms, rounds) = match extent {
        Extent::Smoke => (200, 1),
        Extent::Quick => (500, 2),
        Extent::Full => (1500, 7),
    };
    let setting = |&payload_bytes| Setting { task, payload_bytes, idle: Idle::AsShipped, budget_ms, rounds };
    sizes.iter().map(setting).collect()
}

fn over_gateways(extent: Extent) -> Vec<Setting> {
    of_network(Task::RoundTrips { whole: false }, &[64, 4 << 10, 1 << 20], extent)
}

fn streams(task: Task, extent: Extent) -> Vec<Setting> {
    of_network(task, &[64 << 10, 1 << 20], extent)
}

/// Powers of 8, and the two sizes of which ratios are promised.
const SIZES: [usize; 8] = [64, 512, 4 << 10, 32 << 10, 256 << 10, 1 << 20, 2 << 20, 8 << 20];

fn latency(extent: Extent) -> Vec<Setting> {
    type Sizes = &'static [usize];
    let (whole_held, whole_shipped, untouched_held): (Sizes, Sizes, Sizes) = match extent {
        Extent::Smoke => (&[64, 1 << 20], &[64], &[64]),
        Extent::Quick => (&[64, 1 << 20, 8 << 20], &[64, 1 << 20], &[64]),
        Extent::Full => (&SIZES, &SIZES, &SIZES),
    };
    // The slowest are to make some round trips of 8 MiB, too: twenty in all, of which a median is made.
    let (budget_ms, large_ms) = match extent {
        Extent::Smoke => (60, 60),
        Extent::Quick => (100, 650),
        Extent::Full => (100, 400),
    };
    // More where most is promised, and where a machine's phases show most.
    let rounds = |whole, idle, payload_bytes| match (extent, idle, payload_bytes) {
        (Extent::Smoke, ..) => 1,
        (Extent::Quick, Idle::HeldOff, 64) if whole => 3,
        (Extent::Quick, Idle::HeldOff, 0x10_0000) | (Extent::Quick, Idle::AsShipped, 64) => 2,
        (Extent::Quick, ..) => 1,
        (Extent::Full, Idle::HeldOff, 64 | 0x10_0000 | 0x80_0000) if whole => 3,
        (Extent::Full, Idle::AsShipped, 64 | 0x10_0000 | 0x80_0000) if whole => 2,
        (Extent::Full, ..) => 1,
    };
    let setting = |whole, idle, sizes: &[usize]| -> Vec<Setting> {
        let of_size = |&payload_bytes: &usize| Setting {
            task: Task::RoundTrips { whole },
            payload_bytes,
            idle,
            budget_ms: if payload_bytes > 4 << 20 { large_ms } else { budget_ms },
            rounds: rounds(whole, idle, payload_bytes),
        };
        sizes.iter().map(of_size).collect()
    };
    let mut settings = setting(true, Idle::HeldOff, whole_held);
    settings.extend(setting(false, Idle::HeldOff, untouched_held));
    settings.extend(setting(true, Idle::AsShipped, whole_shipped));
    if extent == Extent::Full {
        settings.extend(setting(false, Idle::AsShipped, &[64, 4 << 10, 256 << 10, 8 << 20]));
    }
    settings
}

fn paced(topics: usize, rate: f64, processes: usize, subscribers: usize, is_loaded: bool) -> Task {
    Task::Paced { rate: rate * topics as f64, topics, processes, subscribers, is_loaded, at_once: false }
}

fn open_loop(extent: Extent) -> Vec<Setting> {
    let setting = |is_loaded, idle, budget_ms, rounds| Setting {
        task: paced(1, 1000.0, 1, 1, is_loaded),
        payload_bytes: 1 << 10,
        idle,
        budget_ms,
        rounds,
    };
    let both = |idle, budget_ms, rounds| [false, true].map(|loaded| setting(loaded, idle, budget_ms, rounds));
    match extent {
        Extent::Smoke => both(Idle::HeldOff, 200, 1).into(),
        Extent::Quick => both(Idle::HeldOff, 1000, 1).into(),
        // More than 10,000 messages in all: enough for p99.9. The other setting has enough for p99.
        Extent::Full => [both(Idle::HeldOff, 5100, 2), both(Idle::AsShipped, 1100, 1)].concat(),
    }
}

fn fan_out(extent: Extent) -> Vec<Setting> {
    let setting = |processes, subscribers, idle, budget_ms| Setting {
        task: paced(1, 50.0, processes, subscribers, false),
        payload_bytes: 1 << 20,
        idle,
        budget_ms,
        rounds: 1,
    };
    let both = |counts: &[usize], idle, budget_ms| -> Vec<Setting> {
        let in_one = counts.iter().map(|&count| setting(1, count, idle, budget_ms));
        let many = counts.iter().filter(|&&count| count > 1);
        in_one.chain(many.map(|&count| setting(count, 1, idle, budget_ms))).collect()
    };
    match extent {
        Extent::Smoke => both(&[2], Idle::HeldOff, 200),
        Extent::Quick => {
            vec![
                setting(1, 1, Idle::HeldOff, 600),
                setting(1, 8, Idle::HeldOff, 600),
                setting(4, 1, Idle::HeldOff, 600),
            ]
        }
        Extent::Full => {
            [both(&[1, 2, 4, 8, 16], Idle::HeldOff, 500), both(&[1, 4, 8], Idle::AsShipped, 500)].concat()
        }
    }
}

fn robot(extent: Extent) -> Vec<Setting> {
    let setting = |at_once, idle, budget_ms, rounds| Setting {
        task: Task::Paced {
            rate: 2000.0,
            topics: 20,
            processes: 1,
            subscribers: 1,
            is_loaded: false,
            at_once,
        },
        payload_bytes: 4 << 10,
        idle,
        budget_ms,
        rounds,
    };
    let both = |idle, apart_ms, at_once_ms, rounds| {
        vec![setting(false, idle, apart_ms, rounds), setting(true, idle, at_once_ms, rounds)]
    };
    match extent {
        Extent::Smoke => both(Idle::AsShipped, 500, 200, 1),
        Extent::Quick => both(Idle::AsShipped, 1000, 600, 1),
        // 20 s in all.
        Extent::Full => [both(Idle::AsShipped, 5000, 700, 4), both(Idle::HeldOff, 1000, 600, 1)].concat(),
    }
}

fn throughput(extent: Extent) -> Vec<Setting> {
    let setting = |payload_bytes, idle, budget_ms, rounds| Setting {
        task: Task::Stream { whole: true },
        payload_bytes,
        idle,
        budget_ms,
        rounds,
    };
    let both = |idle, budget_ms, rounds| [64, 1 << 20].map(|bytes| setting(bytes, idle, budget_ms, rounds));
    match extent {
        Extent::Smoke => both(Idle::HeldOff, 100, 1).into(),
        Extent::Quick => both(Idle::HeldOff, 400, 1).into(),
        Extent::Full => [both(Idle::HeldOff, 500, 3), both(Idle::AsShipped, 500, 1)].concat(),
    }
}

fn start_up(extent: Extent) -> Vec<Setting> {
    let setting = |topics, is_late_joiner, idle, rounds| Setting {
        task: Task::Start { topics, is_late_joiner },
        payload_bytes: 64,
        idle,
        budget_ms: 10,
        rounds,
    };
    let all = |idle, rounds| {
        vec![
            setting(1, false, idle, rounds),
            setting(1, true, idle, rounds),
            setting(100, false, idle, rounds),
        ]
    };
    match extent {
        Extent::Smoke | Extent::Quick => all(Idle::AsShipped, 1),
        Extent::Full => [all(Idle::AsShipped, 3), all(Idle::HeldOff, 1)].concat(),
    }
}
