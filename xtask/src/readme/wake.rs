// SPDX-License-Identifier: MIT OR Apache-2.0
//! Round trips by system and by size.

use super::figures::{all_us, machine, size, sizes, table as of_ways, us};
use serde_json::Value;
use std::fmt::Write;

pub(super) fn table(rows: &Value) -> String {
    let rows: Vec<&Value> = rows.as_array().into_iter().flatten().collect();
    let mut out = String::from(
        "64 B, from one process to another, half a round trip, in µs (p50 / p99 / p99.9 / max):\n\n",
    );
    let titles = ["idle states as shipped", "idle states held off"].map(str::to_owned);
    let times = |row: &Value| all_us(row, &["p50_us", "p99_us", "p999_us", "max_us"]);
    out += &of_ways(&rows, "system", &titles, |way| {
        ["as-shipped/untouched", "held-off/untouched"]
            .map(|experiment| way.cell(experiment, 64, times))
            .to_vec()
    });
    out.push_str(
        "\nBy size, idle states held off, p50 in µs (payload untouched / all of it written and read):\n\n",
    );
    let (sizes, p50) = (sizes(&rows), |row: &Value| us(row, "p50_us"));
    let titles: Vec<String> = sizes.iter().map(|&bytes| size(bytes)).collect();
    out += &of_ways(&rows, "system", &titles, |way| {
        let of = |bytes, how| way.cell(&format!("held-off/{how}"), bytes, p50);
        sizes.iter().map(|&bytes| format!("{} / {}", of(bytes, "untouched"), of(bytes, "whole"))).collect()
    });
    let lost: u64 = rows.iter().filter_map(|row| row["lost"].as_u64()).sum();
    let n: u64 = rows.iter().filter_map(|row| row["n"].as_u64()).sum();
    let _ = writeln!(
        out,
        "\n`cargo xtask bench wake`: two processes, FIFO 50, pinned, {n} round trips in alternating rounds, {lost} wake-ups \
         lost; {}. A bare futex is the floor for anything that sleeps; busy polling occupies a core. iceoryx2 alone is faster \
         where it polls: Tautline adds sequence numbers, time stamps, loss counters and a callback.",
        machine()
    );
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tables_have_a_column_per_idle_state_and_one_per_size() {
        let row = |experiment: &str, bytes: u64, us: f64| {
            serde_json::json!({"experiment": experiment, "system": "futex", "mode": "blocking", "payload_bytes": bytes,
                               "p50_us": us, "p99_us": 20.0, "p999_us": 30.0, "max_us": 400.4, "lost": 0, "n": 7})
        };
        let rows = [
            row("as-shipped/untouched", 64, 9.0),
            row("held-off/untouched", 64, 3.0),
            row("held-off/whole", 1 << 20, 33.0),
        ];
        let tables = table(&rows.to_vec().into());
        for line in [
            "| system | idle states as shipped | idle states held off |\n|---|--:|--:|\n",
            "| futex, blocking | 9.00 / 20.00 / 30.00 / 400 | 3.00 / 20.00 / 30.00 / 400 |\n",
            "| system | 64 B | 1 MiB |\n|---|--:|--:|\n| futex, blocking | 3.00 / - | - / 33.00 |\n",
            "21 round trips",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }
}
