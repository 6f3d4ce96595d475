// SPDX-License-Identifier: MIT OR Apache-2.0
//! Round trips of requests.

use super::figures::{machine, us};
use serde_json::Value;
use std::fmt::Write;

/// A line per way to ask and length of the request.
pub(super) fn table(run: &Value) -> String {
    let mut out = String::from(
        "| round trip in µs | bytes asked | n | p50 | p99 | p99.9 | max | lost |\n|---|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    for row in run["rows"].as_array().into_iter().flatten() {
        let _ = writeln!(
            out,
            "| {} {} | {} | {} | {} | {} | {} | {} | {} |",
            row["system"].as_str().unwrap_or("?"),
            row["mode"].as_str().unwrap_or("?"),
            row["payload_bytes"],
            row["n"],
            us(row, "p50_us"),
            us(row, "p99_us"),
            us(row, "p999_us"),
            us(row, "max_us"),
            row["lost"],
        );
    }
    let _ = writeln!(
        out,
        "\n`cargo xtask bench services`: two processes, FIFO 50, each on a core, both blocking, alternating rounds, answers of 64 \
         bytes; in place nothing is copied, r2r's requests are a text that is; {}; {}.",
        run["versions"].as_str().unwrap_or("?"),
        machine()
    );
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_services_table_says_what_was_lost_and_with_which_versions() {
        let run = serde_json::json!({"versions": "r2r 0.9.7", "rows": [
            {"system": "r2r", "mode": "over Fast DDS", "payload_bytes": 64, "n": 10, "p50_us": 123.4, "p99_us": 5.0, "p999_us": 6.0,
             "max_us": 7.0, "lost": 2}]});
        let table = table(&run);
        assert!(table.contains("| r2r over Fast DDS | 64 | 10 | 123 | 5.00 | 6.00 | 7.00 | 2 |"), "{table}");
        assert!(table.contains("r2r 0.9.7"), "{table}");
    }
}
