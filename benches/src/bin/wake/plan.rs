// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is measured.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

/// The priority of all measured threads that receive.
pub const PRIORITY: u8 = 50;

/// The warm-up lasts this fraction (1/8) of the measuring time.
pub const WARM_UP_SHARE: u32 = 8;

/// A way to wake another process. A new one is a variant here and an arm in `Mode::names`, `Mode::ALL` and
/// `child::run_mode`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Mode {
    FutexBlocking,
    FutexOneCore,
    IceoryxBusyPoll,
    IceoryxWaitSet,
    /// Sampler and callback on their process's core.
    TautlineSameCore,
    /// The callback on its process's core, the sampler on the other.
    TautlineTwoCores,
    /// Both processes on one core.
    TautlineOneCore,
    /// The callback polls on its process's core.
    TautlineBusyPoll,
}

impl Mode {
    pub const ALL: [Self; 8] = [
        Self::FutexBlocking,
        Self::TautlineSameCore,
        Self::IceoryxWaitSet,
        Self::TautlineTwoCores,
        Self::FutexOneCore,
        Self::TautlineOneCore,
        Self::IceoryxBusyPoll,
        Self::TautlineBusyPoll,
    ];

    /// The system and its mode, as in the table and the JSON.
    pub fn names(self) -> (&'static str, &'static str) {
        match self {
            Self::FutexBlocking => ("futex", "blocking"),
            Self::FutexOneCore => ("futex", "one-core"),
            Self::IceoryxBusyPoll => ("iceoryx2", "busy-poll"),
            Self::IceoryxWaitSet => ("iceoryx2", "waitset"),
            Self::TautlineSameCore => ("tautline", "same-core"),
            Self::TautlineTwoCores => ("tautline", "two-cores"),
            Self::TautlineOneCore => ("tautline", "one-core"),
            Self::TautlineBusyPoll => ("tautline", "busy-poll"),
        }
    }

    /// Whether both processes share the receiver's core.
    pub fn is_one_core(self) -> bool {
        self.names().1 == "one-core"
    }
}

/// What the cores may do while they wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Idle {
    /// Sleep, as the machine is set up.
    Default,
    /// Nothing: `/dev/cpu_dma_latency` is held at 0.
    Poll,
}

impl Idle {
    pub const ALL: [Self; 2] = [Self::Default, Self::Poll];

    /// The experiment, as in the table and the JSON.
    pub fn experiment(self, touched: bool) -> String {
        let payload = if touched { "whole" } else { "untouched" };
        let idle = match self {
            Idle::Default => "as-shipped",
            Idle::Poll => "held-off",
        };
        format!("{idle}/{payload}")
    }

    /// The names of all experiments.
    pub fn experiments() -> BTreeSet<String> {
        Self::ALL.iter().flat_map(|idle| [false, true].map(|touched| idle.experiment(touched))).collect()
    }
}

/// A message's size and whether both sides go through it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Payload {
    pub bytes: usize,
    /// The sender writes all of it and the receiver reads all of it; else only the first 8 bytes.
    pub touched: bool,
}

/// Everything that is measured.
pub struct Plan {
    pub quick: bool,
    pub realtime: bool,
    pub cores: [usize; 2],
    pub modes: Vec<Mode>,
    pub payloads: Vec<Payload>,
    pub rounds: u32,
}

impl Plan {
    pub fn new(quick: bool, cores: [usize; 2], realtime: bool) -> Self {
        let payload = |bytes, touched| Payload { bytes, touched };
        let payloads = if quick {
            vec![payload(64, false), payload(1 << 20, true), payload(8 << 20, false)]
        } else {
            [64, 4 << 10, 1 << 20, 8 << 20]
                .iter()
                .flat_map(|&b| [payload(b, false), payload(b, true)])
                .collect()
        };
        Self {
            quick,
            realtime,
            cores,
            modes: Mode::ALL.to_vec(),
            payloads,
            rounds: if quick { 3 } else { 5 },
        }
    }

    /// How many pairs of processes will run.
    pub fn runs(&self) -> u32 {
        let cells = self.modes.len() * self.payloads.len() * Idle::ALL.len();
        u32::try_from(cells).unwrap_or(u32::MAX).saturating_mul(self.rounds)
    }

    /// The measuring time of one pair, such that all fit into 45 s (quick) or 300 s.
    pub fn budget(&self) -> Duration {
        let total = Duration::from_secs(if self.quick { 45 } else { 300 });
        let start_and_end = Duration::from_millis(50);
        let with_warm_up = (total / self.runs()).saturating_sub(start_and_end);
        (with_warm_up * WARM_UP_SHARE / (WARM_UP_SHARE + 1)).max(Duration::from_millis(100))
    }
}

/// Which process of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Sends first and holds the clock.
    Ping,
    /// Answers.
    Pong,
}

/// What one process of a pair is told.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Job {
    pub role: Role,
    pub mode: Mode,
    pub payload: Payload,
    pub budget: Duration,
    /// The ping's and the pong's core.
    pub cores: [usize; 2],
    pub realtime: bool,
    /// Different for each pair of a run: part of the topics' names.
    pub pair: u32,
    /// Starts the names of all files in /dev/shm.
    pub prefix: String,
    /// Where other files go.
    pub directory: PathBuf,
}

impl Job {
    /// This process's core.
    pub fn core(&self) -> usize {
        match self.role {
            Role::Ping => self.cores[0],
            Role::Pong => self.cores[1],
        }
    }
}
