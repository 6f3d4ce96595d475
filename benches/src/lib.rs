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
//! the machine. Absolute times belong to the machine; ratios within a run are what is compared. `systems` are the ends of an exchange
//! that a bench runs itself, a `Stage` is where callbacks are measured; `tautline-harness` has the rest.
#![allow(missing_docs, reason = "many names say it all")]

mod stage;
pub mod systems;

pub use stage::Stage;
