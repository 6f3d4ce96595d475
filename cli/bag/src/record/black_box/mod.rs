// SPDX-License-Identifier: MIT OR Apache-2.0
//! The black box: the last seconds stay in memory, and are written when something happens.
//!
//! Messages stay in the ring that the reader fills: `dumper` drops those that are too old, and writes the others at an alarm of `alarms`.
//! `tracing` keeps trace events beside them.

mod alarms;
mod dumper;
mod tracing;

pub use alarms::Alarms;
pub use dumper::{Dump, Dumped, Dumper, Plan};
pub use tracing::Tracing;

use super::statement::Statement;
use crate::ring::LATCHED_BYTES;
use serde_json::json;
use std::io::Write;
use std::path::Path;
use taut_cli::table::count;
use taut_cli::verb::{Failure, Outcome};

/// Prints the result of a black box.
pub fn print(is_json: bool, folder: &Path, dumped: Outcome<Dumped>, statement: &Statement) -> Outcome {
    let out = &mut taut_cli::print::stdout();
    let mut printed = if is_json { Ok(()) } else { statement.table(out) };
    let (dumped, lost) = (dumped?, statement.lost());
    if is_json {
        let bags: Vec<_> = dumped.dumps.iter().map(Dump::json).collect();
        let shortest = dumped.shortest_ns;
        let report = json!({
            "black_box": folder.display().to_string(), "bags": bags, "lost": lost, "unusable": dumped.unusable, "removed": dumped.removed,
            "shortest_ns": shortest,
        });
        printed = writeln!(out, "{report}");
    } else {
        let bags = count(dumped.dumps.len(), "bag");
        let loss = if lost == 0 { "nothing lost".to_owned() } else { format!("{lost} LOST") };
        printed = printed.and_then(|()| writeln!(out, "{}: {bags}, {loss}", folder.display()));
        for dump in &dumped.dumps {
            printed = printed.and_then(|()| writeln!(out, "  {}", dump.line()));
        }
    }
    // The verdict takes precedence over an error of printing.
    if let Some(short_ns) = dumped.shortest_ns {
        eprintln!(
            "taut: warning: --budget had room for {:.1} s only: a greater one keeps all of --black-box",
            short_ns as f64 / 1e9
        );
    }
    for (topic, messages) in &dumped.unlatched {
        eprintln!(
            "taut: warning: {topic}: {messages} messages that its publishers keep for late joiners were not kept: of a topic the black \
             box keeps {} MiB of them",
            LATCHED_BYTES >> 20
        );
    }
    if let Some(error) = dumped.failed {
        return Err(error.into());
    }
    match lost + dumped.unusable {
        0 => printed.map_err(Failure::from),
        missing => Err(Failure::no(format!(
            "{missing} messages are missing; a greater --depth survives longer stalls, a greater --budget slower disks"
        ))),
    }
}
