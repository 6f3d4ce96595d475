// SPDX-License-Identifier: MIT OR Apache-2.0
//! The three processes: what each is asked to be, and how they begin and end together.
//!
//! Who starts them starts the visualizer and the ALKS node first; each says that it is ready once it hears its topics. Then it
//! starts the adapter, which drives for as long as it is asked, tells its [`Part`] and ends. The others end, with theirs, when
//! their standard input does: also when who started them has died.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use tautline_exchange::say;

pub use tautline_exchange::until_told;

use crate::records::Part;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Role {
    /// In place of the car and its FlexRay bus.
    Adapter,
    Alks,
    /// What makes markers.
    Visualizer,
}

/// How the subscribers of the ALKS node share with its timer what they know.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Shared {
    /// Wait-free: neither waits for the other.
    Latest,
    /// A lock whose holder inherits the priority of who waits.
    Inherit,
    /// A lock of the standard library, as in the paper.
    Mutex,
}

impl Shared {
    pub const ALL: [Shared; 3] = [Shared::Latest, Shared::Inherit, Shared::Mutex];

    pub const fn as_str(self) -> &'static str {
        match self {
            Shared::Latest => "latest",
            Shared::Inherit => "inherit",
            Shared::Mutex => "mutex",
        }
    }
}

/// What a process is asked to be. JSON on its command line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Job {
    pub role: Role,
    /// How long is measured, after a second that is not.
    pub seconds: f64,
    /// Of road, traffic and noise.
    pub seed: u64,
    pub realtime: bool,
    pub shared: Shared,
    /// Who runs where, for a middleware that has such files.
    pub system_file: Option<PathBuf>,
}

/// Time that does not count, in ns: the car finds its lane, memory is touched for the first time.
pub const WARM_UP_NS: u64 = 1_000_000_000;

impl Job {
    /// When the adapter's last step is, if its first is at `first_ns`.
    pub fn end_ns(&self, first_ns: u64) -> u64 {
        first_ns + WARM_UP_NS + (self.seconds * 1e9) as u64
    }

    pub fn minutes(&self) -> f64 {
        (self.seconds + 2.0) / 60.0
    }
}

/// What a process says: a line of JSON on its standard output.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Line {
    /// It hears its topics.
    Ready,
    Part(Box<Part>),
}

pub fn ready() {
    say(&Line::Ready);
}

pub fn tell(part: Part) {
    say(&Line::Part(Box::new(part)));
}
