// SPDX-License-Identifier: MIT OR Apache-2.0
//! What measurements have in common. It knows neither topics nor systems, so that a bench of any workspace may use it.
//!
//! | module | holds |
//! |---|---|
//! | `process`, `gateways`, `beside` | processes that measure, and what goes on beside them |
//! | `rows` | what was measured of systems beside each other |
//! | `readings` | what was measured in other units |
//! | `claims`, `verdict` | goals between rows; what is said of each figure that has a goal |
//! | `table`, `page`, `canvas`, `bars`, `histogram` | rows and readings for the terminal, the documents and a browser |
//! | `program` | what the programs of benches are told, and do |
//! | `machine`, `scratch` | where a bench runs: what disturbs it, and what it leaves |
//! | `turns` | ratios of parts that take turns |
#![allow(missing_docs, reason = "many names say it all")]

pub mod bars;
mod beside;
pub mod canvas;
pub mod claims;
mod distribution;
mod gateways;
mod histogram;
mod machine;
pub mod page;
mod process;
mod program;
pub mod readings;
pub mod rows;
mod scratch;
pub mod table;
mod turns;
pub mod verdict;

pub use beside::Beside;
pub use distribution::Distribution;
pub use gateways::{Gateways, Host};
pub use histogram::{Series, histogram};
pub use machine::{Disturbance, machine, version_of};
pub use process::{Process, without_settings};
pub use program::{
    Documented, Run, exit, interrupted, one_core, program, progress_bar, two_cores, write, write_json,
};
pub use scratch::Scratch;
pub use turns::{TurnRow, Turns};

/// An error for people only, which threads may pass on.
pub type Error = Box<dyn std::error::Error + Send + Sync>;
/// With an [`Error`].
pub type Result<T = ()> = std::result::Result<T, Error>;

/// The cells of a table's row.
#[macro_export]
macro_rules! cells {
    ($($cell:expr),* $(,)?) => { [$($crate::table::Cell::from($cell)),*] };
}
