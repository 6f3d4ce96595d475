// SPDX-License-Identifier: MIT OR Apache-2.0
//! The table, the JSON, and what must hold.

use serde::Serialize;
use tautline_benches::claims::Verdict;
use tautline_benches::table::Column::{Number, Words};
use tautline_benches::table::{Table, distinct, figure, markdown};
use tautline_benches::{cells, machine, version_of};

use crate::cases::{FLOOR, IN_PLACE, OWNED, PUBLISHED_ONLY};
use crate::rounds::median_ratio;

#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub case: &'static str,
    pub implementation: &'static str,
    /// Length of the body.
    pub bytes: usize,
    pub n: u64,
    pub p50_us: f64,
    pub p99_us: f64,
    pub ratio_to_plain_buffer: f64,
    /// The median of each round in ns, for comparison with rivals of that round.
    #[serde(skip)]
    pub rounds_ns: Vec<f64>,
}

pub fn print(rows: &[Row], core: usize, disturbance: &str) {
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
    verdicts(rows).iter().for_each(|verdict| println!("{verdict}"));
}

fn table(rows: &[Row]) -> Table {
    let words = [Words("message"), Number("bytes"), Words("implementation")];
    let numbers = ["n", "p50", "p99", "ratio"].map(Number);
    let mut table = Table::new(2, [&words[..], &numbers].concat());
    for row in rows {
        let [p50, p99] = [row.p50_us, row.p99_us].map(|us| format!("{us:.3}"));
        let ratio = format!("{:.2}", row.ratio_to_plain_buffer);
        table.add(cells![row.case, row.bytes, row.implementation, row.n, p50, p99, ratio]);
    }
    table
}

/// A line per message, a column per way to handle it.
pub fn document(rows: &[Row]) -> String {
    let ways = distinct(rows.iter().map(|row| row.implementation));
    let us = |us: f64| if us < 1.0 { format!("{us:.3}") } else { figure(Some(us)) };
    let line = |case: &'static str| {
        let time = |way: &&str| {
            let row = rows.iter().find(|row| (row.case, row.implementation) == (case, *way));
            row.map_or("-".to_owned(), |row| us(row.p50_us))
        };
        let bytes = rows.iter().find(|row| row.case == case).map_or(0, |row| row.bytes);
        [case.to_owned(), bytes.to_string()].into_iter().chain(ways.iter().map(time)).collect()
    };
    let titles = ["message", "bytes"].into_iter().chain(ways.iter().copied());
    let table = markdown(titles, 1, distinct(rows.iter().map(|row| row.case)).into_iter().map(line));
    format!("{table}\n`cargo xtask bench messages`: medians in µs, one process, one core; {}.\n", machine())
}

/// What must hold between the rows of a run. A miss is printed, never an error: the machine has its part in it.
fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let mut verdicts = Vec::new();
    for case in distinct(rows.iter().map(|row| row.case)) {
        let find =
            |implementation| rows.iter().find(|row| (row.case, row.implementation) == (case, implementation));
        let rivals = rows.iter().filter(|row| row.case == case && row.implementation.contains("cdr"));
        let large = find(PUBLISHED_ONLY).is_some();
        let mut judge = |claim: String, measured: f64, most: f64| {
            let found = format!("{measured:.3}, at most {most:.3}");
            verdicts.push(Verdict::new(format!("{case}: {claim}"), found, Some(measured <= most)));
        };
        if large && let Some(row) = find(IN_PLACE) {
            judge(format!("{IN_PLACE} / {FLOOR}"), row.ratio_to_plain_buffer, 1.1);
        }
        let (ours, most) = if large { (PUBLISHED_ONLY, 0.2) } else { (OWNED, 1.0) };
        let Some(row) = find(ours) else { continue };
        for rival in rivals {
            let ratio = median_ratio(&row.rounds_ns, &rival.rounds_ns);
            judge(format!("{ours} / {}", rival.implementation), ratio, most);
        }
    }
    verdicts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documents_table_has_a_line_per_message_and_a_column_per_way() {
        let row = |case, implementation, bytes, p50_us| {
            let rounds_ns = Vec::new();
            Row {
                case,
                implementation,
                bytes,
                n: 1,
                p50_us,
                p99_us: p50_us,
                ratio_to_plain_buffer: 1.0,
                rounds_ns,
            }
        };
        let rows = [row("a", "x", 8, 0.0042), row("a", "y", 8, 123.4), row("b", "y", 9, 1.25)];
        let expected = "| message | bytes | x | y |\n|---|--:|--:|--:|\n| a | 8 | 0.004 | 123 |\n| b | 9 | - | 1.25 |\n\n`cargo";
        let table = document(&rows);
        assert!(table.starts_with(expected), "{table}");
    }
}
