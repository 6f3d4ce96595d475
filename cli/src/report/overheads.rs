// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut report --overheads`: what executors of ROS's client libraries use for each callback, for `[overheads]` of the system file.
use std::io::Write;
use std::time::Duration;

use serde_json::{Value, json};
use tautline_executor::ExecutorSnapshot;

use super::run::unread;
use super::verdict::Verdict;
use crate::table::{WARNING, wrap, write_table};
use crate::times::ms;
use crate::verb::{CommonArgs, Failure, Outcome};

/// The margin that is added to the longest measured time, in percent.
const MARGIN: u64 = 20;

/// An executor of a process.
struct Measured {
    process: String,
    executor: ExecutorSnapshot,
}

/// What the processes of `domain` measure.
fn measured(domain: u32) -> Outcome<Vec<Measured>> {
    let (processes, _) = tautline_system::shared_statistics(domain)?;
    let mut found = Vec::new();
    for process in processes {
        let Some(snapshot) = process.read().map_err(unread)? else { continue };
        let label = tautline_system::label_of(&snapshot.process);
        let executors = snapshot.executors.into_iter().filter(|executor| executor.overhead.n() > 0);
        found.extend(executors.map(|executor| Measured { process: label.clone(), executor }));
    }
    Ok(found)
}

/// The lines of `[overheads]` that the processes of `domain` measure, each with where its value comes from.
pub fn measured_lines(domain: u32) -> Outcome<Vec<(String, String)>> {
    let line = |(library, value, longest): (&str, String, &ExecutorSnapshot)| {
        (format!("{library} = \"{value}\""), source(longest))
    };
    Ok(lines(&measured(domain)?).map(line).collect())
}

/// Prints what was measured, and the lines for the system file.
pub fn report(common: &CommonArgs) -> Outcome<Verdict> {
    let domain = common.domain()?;
    let found = measured(domain)?;
    if found.is_empty() {
        return Err(Failure::unusable(format!(
            "no process of domain {domain} shows what its executor uses: start nodes of rclcpp or rclpy on rmw_tautline with \
             TAUT_OVERHEADS=on, and let their callbacks run"
        )));
    }
    let mut out = crate::print::stdout();
    if common.json {
        let rows: Vec<Value> = found.iter().map(Measured::to_json).collect();
        let overheads: serde_json::Map<_, _> =
            lines(&found).map(|(library, value, _)| (library.to_owned(), value.into())).collect();
        writeln!(out, "{}", json!({ "executors": rows, "margin_percent": MARGIN, "overheads": overheads }))?;
    } else {
        let head = ["executor", "process", "callbacks", "n", "p50\nus", "p99\nus", "max\nus"];
        write_table(&head, 3, found.iter().map(|measured| (true, measured.cells())).collect(), &mut out)?;
        writeln!(out, "\n[overheads]")?;
        for (library, value, longest) in lines(&found) {
            writeln!(out, "{library} = \"{value}\" # {}", source(longest))?;
        }
        for (library, ..) in lines(&found).filter(|(.., longest)| !longest.is_alone) {
            let note = format!(
                "of {library} the time until a message is taken: what its executor does after a callback counts as the callback's, as in \
                 `taut report --wcet`. If a wcet was measured within the callback, run empty ones with TAUT_OVERHEADS=empty: docs/report.md"
            );
            writeln!(out, "{WARNING}note:{WARNING:#} {}", wrap(&note))?;
        }
    }
    out.flush()?;
    Ok(Verdict::Kept)
}

/// For each client library its name, the value for the file, and the executor with the longest time, those with empty callbacks first.
fn lines(found: &[Measured]) -> impl Iterator<Item = (&str, String, &ExecutorSnapshot)> {
    ["rclcpp", "rclpy"].into_iter().filter_map(|library| {
        let of = found.iter().map(|measured| &measured.executor).filter(|of| of.name == library);
        let longest = of.max_by_key(|of| (of.is_alone, of.overhead.max()))?;
        let ns = longest.overhead.max().as_nanos().saturating_mul(u128::from(100 + MARGIN)).div_ceil(100);
        Some((library, format!("{}us", ns.div_ceil(1_000)), longest))
    })
}

/// Where the value for the file comes from.
fn source(longest: &ExecutorSnapshot) -> String {
    let (us, n) = (us(longest.overhead.max()), longest.overhead.n());
    format!("at most {us:.1}us in {n} callbacks, and {MARGIN} % more")
}

impl Measured {
    fn callbacks(&self) -> &'static str {
        if self.executor.is_alone { "empty" } else { "any" }
    }

    fn cells(&self) -> Vec<String> {
        let overhead = &self.executor.overhead;
        let times =
            [overhead.p(0.5), overhead.p(0.99), overhead.max()].map(|time| format!("{:.1}", us(time)));
        let text = [self.executor.name.clone(), self.process.clone(), self.callbacks().into()];
        text.into_iter().chain([overhead.n().to_string()]).chain(times).collect()
    }

    fn to_json(&self) -> Value {
        let ExecutorSnapshot { name, overhead, callbacks, .. } = &self.executor;
        json!({
            "executor": name, "process": self.process, "callbacks": self.callbacks(), "n": overhead.n(),
            "p50_us": us(overhead.p(0.5)), "p99_us": us(overhead.p(0.99)), "max_us": us(overhead.max()),
            "sum_ms": ms(overhead.sum_ns()), "callbacks_sum_ms": ms(callbacks.sum_ns()),
        })
    }
}

fn us(time: Duration) -> f64 {
    time.as_nanos() as f64 / 1e3
}
