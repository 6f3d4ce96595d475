// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is measured.

use std::path::PathBuf;
use std::time::Duration;

use clap::ValueEnum;
use tautline_exchange::Exchange;

use crate::{Options, Result};

/// A question.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Experiment {
    /// Half round trips
    RoundTrip,
    /// How much arrives in a second
    Stream,
    /// Response times of local callbacks while a flood arrives
    Callbacks,
}

/// Callbacks, without and with a flood.
pub const QUIET: &str = "callbacks/quiet";
pub const FLOOD: &str = "callbacks/flood";

impl Experiment {
    /// Its parts' names, as in the JSON.
    pub fn names(self) -> &'static [&'static str] {
        match self {
            Experiment::RoundTrip => &["round-trip"],
            Experiment::Stream => &["stream"],
            Experiment::Callbacks => &[QUIET, FLOOD],
        }
    }
}

/// A way from one process to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum System {
    /// Zenoh's own publishers and subscribers
    Zenoh,
    /// Nodes, each with a gateway
    Tautline,
    /// Another implementation of ROS 2's API over Zenoh
    Hiroz,
}

impl System {
    /// As in the table and the JSON.
    pub fn name(self) -> &'static str {
        match self {
            System::Zenoh => "zenoh",
            System::Tautline => "tautline",
            System::Hiroz => "hiroz",
        }
    }
}

/// One way to do one thing with one payload.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Case {
    pub experiment: Experiment,
    pub system: System,
    pub exchange: Exchange,
    pub payload_bytes: usize,
    /// Whether its threads have real-time priorities.
    pub realtime: bool,
}

impl Case {
    /// How it is done, as in the table and the JSON.
    pub fn mode(&self) -> &'static str {
        match (self.exchange, self.system, self.realtime) {
            (Exchange::Stream { window: Some(_) }, _, true) => "window",
            (Exchange::Stream { window: Some(_) }, _, false) => "window, ordinary threads",
            (Exchange::Stream { window: None }, _, true) => "unbounded",
            (Exchange::Stream { window: None }, _, false) => "unbounded, ordinary threads",
            (_, System::Tautline, _) => "node-to-node",
            (_, _, true) => "pub-sub",
            (_, _, false) => "pub-sub, ordinary threads",
        }
    }
}

/// Bytes of a stream that may be under way.
const WINDOW_BYTES: usize = 4 << 20;

/// Everything that is measured.
pub struct Plan {
    pub realtime: bool,
    /// Each host's; `None`: any.
    pub cores: [Option<usize>; 2],
    /// The last core, for callbacks, and the other.
    pub both: [usize; 2],
    pub experiments: Vec<Experiment>,
    pub cases: Vec<Case>,
    pub rounds: u32,
    /// Length of one measurement.
    pub budget: Duration,
    /// Rounds of the experiment with callbacks, and their length.
    pub callbacks: (u32, u64),
    pub hiroz: std::result::Result<PathBuf, String>,
    pub gateway: PathBuf,
    pub taut: PathBuf,
}

impl Plan {
    pub fn new(options: &Options, both: [usize; 2]) -> Result<Self> {
        let experiments = chosen(&options.only);
        let systems = chosen(&options.systems);
        let beside = std::env::current_exe()?.parent().map(PathBuf::from).unwrap_or_default();
        let program = |named: &Option<PathBuf>, name| named.clone().unwrap_or_else(|| beside.join(name));
        let hiroz = match (&options.without_hiroz, &options.hiroz) {
            (Some(reason), _) => Err(reason.clone()),
            (None, Some(program)) => Ok(program.clone()),
            (None, None) => Ok(beside.join("network-hiroz")),
        };
        let mut cases = Vec::new();
        let mut add = |experiment, exchange, payload_bytes, only: &[System]| {
            for &system in systems.iter().filter(|system| only.contains(system)) {
                if experiments.contains(&experiment) && (system != System::Hiroz || hiroz.is_ok()) {
                    cases.push(Case {
                        experiment,
                        system,
                        exchange,
                        payload_bytes,
                        realtime: !options.no_rt,
                    });
                    // As it comes: its threads at one real-time priority wake one another for every packet.
                    if system == System::Zenoh && !options.no_rt {
                        cases.push(Case { experiment, system, exchange, payload_bytes, realtime: false });
                    }
                }
            }
        };
        for payload_bytes in [64, 4 << 10, 1 << 20] {
            add(Experiment::RoundTrip, Exchange::RoundTrips, payload_bytes, System::value_variants());
        }
        for payload_bytes in [64 << 10, 1 << 20] {
            let window = Exchange::Stream { window: Some((WINDOW_BYTES / payload_bytes) as u64) };
            add(Experiment::Stream, window, payload_bytes, System::value_variants());
            // As Zenoh's own example: what it has beside a window, and we do not, is a publisher that waits.
            add(Experiment::Stream, Exchange::Stream { window: None }, payload_bytes, &[System::Zenoh]);
        }
        Ok(Plan {
            realtime: !options.no_rt,
            cores: if options.no_cores { [None; 2] } else { both.map(Some) },
            both,
            experiments,
            cases,
            rounds: options.rounds.unwrap_or(if options.quick { 2 } else { 7 }),
            budget: Duration::from_millis(if options.quick { 500 } else { 1500 }),
            callbacks: if options.quick { (1, 4) } else { (5, 10) },
            hiroz,
            gateway: program(&options.gateway, "taut-gateway"),
            taut: program(&options.taut, "taut"),
        })
    }

    /// How many pairs of processes will run.
    pub fn runs(&self) -> u64 {
        self.cases.len() as u64 * u64::from(self.rounds)
    }
}

/// All, unless some were named.
fn chosen<T: ValueEnum + Clone>(named: &[T]) -> Vec<T> {
    if named.is_empty() { T::value_variants().to_vec() } else { named.to_vec() }
}
