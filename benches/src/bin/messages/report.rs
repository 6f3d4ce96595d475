// SPDX-License-Identifier: MIT OR Apache-2.0
//! The table, the JSON, and what must hold.

use tautline_harness::claims::{Claim, Goal, Ways, judge};
use tautline_harness::rows::{By, Compared, Figure, Metric, Row};
use tautline_harness::table::Column::{Number, Words};
use tautline_harness::table::{Table, distinct, figure, markdown};
use tautline_harness::verdict::{self, Verdict};
use tautline_harness::{Result, cells, machine, version_of};

use crate::cases::{
    FLOOR, IMAGE, IMU, IN_PLACE, JOINT_STATE, OWNED, POINT_CLOUD, PUBLISHED_ONLY, TF_MESSAGE, TWIST,
};

pub fn print(rows: &[Row], core: usize, disturbance: &str) -> Result<()> {
    let version = |package| version_of(package).unwrap_or("?");
    println!("{}", machine());
    println!(
        "tautline {}, cdr-encoding {}, hiroz-cdr {}; core {core}; {disturbance}",
        version("tautline"),
        version("cdr-encoding"),
        version("hiroz-cdr")
    );
    println!("one process; µs per message; ratio to filling and reading a plain buffer of the same size");
    println!("{}", table(rows));
    verdict::print(&verdicts(rows))
}

/// In place no slower than a plain buffer, large messages far ahead of encoders, small ones not behind them.
fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let at_most = |times, experiment, ours, system| {
        let ours = Ways::new(experiment, None, "tautline", ours);
        Claim::new(Metric::P50, ours, Goal::Times(times, Ways::new(experiment, None, system, &[])))
    };
    let mut claims = Vec::new();
    for message in [IMAGE, POINT_CLOUD] {
        claims.push(at_most(1.1, message, &[IN_PLACE.1], FLOOR.0));
        claims.extend(ENCODERS.map(|rival| at_most(0.2, message, &[PUBLISHED_ONLY.1], rival)));
    }
    for message in [TWIST, IMU, JOINT_STATE, TF_MESSAGE] {
        claims.extend(ENCODERS.map(|rival| at_most(1.0, message, &[OWNED], rival)));
    }
    judge(rows, claims)
}

const ENCODERS: [&str; 2] = ["cdr-encoding", "hiroz-cdr"];

/// What others than Tautline do is one thing each.
fn way(row: &Row) -> String {
    match &*row.system {
        "tautline" => row.name(),
        "floor" => row.mode.clone(),
        rival => rival.to_owned(),
    }
}

fn table(rows: &[Row]) -> Table {
    let words = [Words("message"), Number("bytes"), Words("implementation")];
    let numbers = ["n", "p50", "p99", "ratio"].map(Number);
    let mut table = Table::new(2, [&words[..], &numbers].concat());
    for row in rows {
        let floor =
            rows.iter().find(|other| (&other.experiment, &*other.system) == (&row.experiment, "floor"));
        let ratio = floor.and_then(|floor| Compared::of(row, floor, Figure::from(Metric::P50), By::Ratio));
        let ratio = ratio.map_or("-".to_owned(), |ratio| format!("{:.2}", ratio.median));
        let [p50, p99] =
            [row.p50_us, row.p99_us].map(|us| us.map_or("-".to_owned(), |us| format!("{us:.3}")));
        table.add(cells![&row.experiment, row.payload_bytes, way(row), row.n, p50, p99, ratio]);
    }
    table
}

/// A line per message, a column per way to handle it.
pub fn document(rows: &[Row]) -> String {
    let ways = distinct(rows.iter().map(way));
    let us = |us: f64| if us < 1.0 { format!("{us:.3}") } else { figure(Some(us)) };
    let line = |case: &String| {
        let of_case: Vec<&Row> = rows.iter().filter(|row| row.experiment == *case).collect();
        let time = |name: &String| {
            let row = of_case.iter().find(|row| way(row) == *name);
            row.and_then(|row| row.p50_us).map_or("-".to_owned(), us)
        };
        let bytes = of_case.first().map_or(0, |row| row.payload_bytes);
        [case.clone(), bytes.to_string()].into_iter().chain(ways.iter().map(time)).collect()
    };
    let titles = ["message", "bytes"].into_iter().chain(ways.iter().map(String::as_str));
    let table = markdown(titles, 1, distinct(rows.iter().map(|row| &row.experiment)).into_iter().map(line));
    format!("{table}\n`cargo xtask bench messages`: medians in µs, one process, one core; {}.\n", machine())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cases::OWNED;

    #[test]
    fn the_documents_table_has_a_line_per_message_and_a_column_per_way() {
        let row = |case: &str, (system, mode): (&str, &str), payload_bytes, us| Row {
            experiment: case.to_owned(),
            system: system.to_owned(),
            mode: mode.to_owned(),
            payload_bytes,
            p50_us: Some(us),
            ..Row::default()
        };
        let (ours, rival) = (("tautline", "x"), ("y", OWNED));
        let rows = [row("a", ours, 8, 0.0042), row("a", rival, 8, 123.4), row("b", rival, 9, 1.25)];
        let expected = "| message | bytes | tautline x | y |\n|---|--:|--:|--:|\n| a | 8 | 0.004 | 123 |\n| b | 9 | - | 1.25 |\n\n`cargo";
        let table = document(&rows);
        assert!(table.starts_with(expected), "{table}");
    }
}
