// SPDX-License-Identifier: MIT OR Apache-2.0
//! Of each experiment of a bench: payloads, idle states, lengths and rounds.

use crate::plan::{Bench, Experiment, Idle, Task};

/// How much of it.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    Smoke,
    Quick,
    Full,
}

/// One setting of an experiment, for every mode that takes part.
#[derive(Clone, Copy)]
pub struct Setting {
    pub task: Task,
    pub payload_bytes: usize,
    pub idle: Idle,
    pub budget_ms: u64,
    pub rounds: u32,
}

impl Setting {
    fn of(task: Task, payload_bytes: usize, idle: Idle, budget_ms: u64, rounds: u32) -> Self {
        Setting { task, payload_bytes, idle, budget_ms, rounds }
    }
}

pub fn settings(bench: Bench, experiment: Experiment, extent: Extent) -> Vec<Setting> {
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
            settings.push(Setting::of(Task::RoundTrips { whole }, payload_bytes, idle, budget_ms, rounds));
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
    let of_size = |bytes| Setting::of(Task::Requests, bytes, Idle::HeldOff, budget_ms, rounds);
    [64, 4 << 10, 1 << 20].map(of_size).into()
}

fn of_network(task: Task, sizes: &[usize], extent: Extent) -> Vec<Setting> {
    let (budget_ms, rounds) = match extent {
        Extent::Smoke => (200, 1),
        Extent::Quick => (500, 2),
        Extent::Full => (1500, 7),
    };
    let of_size = |&bytes| Setting::of(task, bytes, Idle::AsShipped, budget_ms, rounds);
    sizes.iter().map(of_size).collect()
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
        let of_size = |&bytes: &usize| {
            let budget_ms = if bytes > 4 << 20 { large_ms } else { budget_ms };
            Setting::of(Task::RoundTrips { whole }, bytes, idle, budget_ms, rounds(whole, idle, bytes))
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

/// At `rate` on each topic.
pub fn paced(
    topics: usize,
    rate: f64,
    processes: usize,
    subscribers: usize,
    is_loaded: bool,
    at_once: bool,
) -> Task {
    Task::Paced { rate: rate * topics as f64, topics, processes, subscribers, is_loaded, at_once }
}

fn open_loop(extent: Extent) -> Vec<Setting> {
    let both = |idle, ms, rounds| {
        let of = |loaded| Setting::of(paced(1, 1000.0, 1, 1, loaded, false), 1 << 10, idle, ms, rounds);
        [false, true].map(of)
    };
    match extent {
        Extent::Smoke => both(Idle::HeldOff, 200, 1).into(),
        Extent::Quick => both(Idle::HeldOff, 1000, 1).into(),
        // More than 10,000 messages in all: enough for p99.9. The other setting has enough for p99.
        Extent::Full => [both(Idle::HeldOff, 5100, 2), both(Idle::AsShipped, 1100, 1)].concat(),
    }
}

fn fan_out(extent: Extent) -> Vec<Setting> {
    let setting = |processes, subscribers, idle, budget_ms| {
        Setting::of(paced(1, 50.0, processes, subscribers, false, false), 1 << 20, idle, budget_ms, 1)
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
    let both = |idle, apart_ms, at_once_ms, rounds| {
        let setting = |(at_once, budget_ms)| {
            Setting::of(paced(20, 100.0, 1, 1, false, at_once), 4 << 10, idle, budget_ms, rounds)
        };
        [(false, apart_ms), (true, at_once_ms)].map(setting)
    };
    match extent {
        Extent::Smoke => both(Idle::AsShipped, 500, 200, 1).into(),
        Extent::Quick => both(Idle::AsShipped, 1000, 600, 1).into(),
        // 20 s in all.
        Extent::Full => [both(Idle::AsShipped, 5000, 700, 4), both(Idle::HeldOff, 1000, 600, 1)].concat(),
    }
}

fn throughput(extent: Extent) -> Vec<Setting> {
    let stream = Task::Stream { whole: true };
    let both = |idle, budget_ms, rounds| {
        [64, 1 << 20].map(|bytes| Setting::of(stream, bytes, idle, budget_ms, rounds))
    };
    match extent {
        Extent::Smoke => both(Idle::HeldOff, 100, 1).into(),
        Extent::Quick => both(Idle::HeldOff, 400, 1).into(),
        Extent::Full => [both(Idle::HeldOff, 500, 3), both(Idle::AsShipped, 500, 1)].concat(),
    }
}

fn start_up(extent: Extent) -> Vec<Setting> {
    let all = |idle, rounds| {
        let setting = |(topics, is_late_joiner)| {
            Setting::of(Task::Start { topics, is_late_joiner }, 64, idle, 10, rounds)
        };
        [(1, false), (1, true), (100, false)].map(setting)
    };
    match extent {
        Extent::Smoke | Extent::Quick => all(Idle::AsShipped, 1).into(),
        Extent::Full => [all(Idle::AsShipped, 3), all(Idle::HeldOff, 1)].concat(),
    }
}
