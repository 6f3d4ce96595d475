// SPDX-License-Identifier: MIT OR Apache-2.0
//! Measurements, one question each.
//!
//! | binary | question |
//! |---|---|
//! | `deadlines` | how late the event of a missed deadline is, beside a timer and a bare sleep |
//! | `messages` | what writing, publishing and reading a message costs, beside a plain buffer and other encoders |
//! | `parameters` | what reading a parameter costs a callback, and whether a thread that sets parameters disturbs it |
//! | `paper` | do the response times of an ECRTS 2025 paper hold, with Tautline and with r2r, and only for the structure that it proposes |
//! | `compare` | Tautline beside other middleware: latency, load, fan-out, throughput, start-up; wake-ups, requests, gateways; in a package of its own |
//! | `tools` | whether a publisher notices that `taut` looks at its topic |
//! | `trace` | what a trace event costs, recorded and not |
//! | `budgets` | whether a callback that overruns its budget makes others miss their deadlines |
//!
//! A measurement runs its rivals in alternating rounds of one run, on pinned cores, and states percentiles, counts and
//! the machine. Absolute times belong to the machine; ratios within a run are what is compared: `rows` has the form of what was
//! measured of systems beside each other, `readings` that of everything else, `claims.toml` what must hold, `claims` judges it, `table` and
//! `page` show it. `systems` are the ends of an exchange that a bench runs itself.
#![allow(missing_docs, reason = "many names say it all")]

mod beside;
pub mod canvas;
pub mod claims;
mod distribution;
mod gateways;
mod machine;
pub mod page;
mod process;
mod program;
pub mod readings;
pub mod rows;
mod run;
mod scratch;
mod stage;
pub mod systems;
pub mod table;
mod turns;

pub use beside::Beside;
pub use distribution::Distribution;
pub use gateways::{Gateways, Host};
pub use machine::{Disturbance, machine, version_in, version_of};
pub use process::Process;
pub use program::{exit, interrupted, progress_bar, two_cores, write, write_json};
pub use run::{Documented, Run, one_core, program};
pub use scratch::Scratch;
pub use stage::Stage;
pub use turns::{TurnRow, Turns};

/// What nobody handles but the person who reads it.
pub type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error>>;

/// The cells of a table's row.
#[macro_export]
macro_rules! cells {
    ($($cell:expr),* $(,)?) => { [$($crate::table::Cell::from($cell)),*] };
}
