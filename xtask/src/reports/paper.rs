// SPDX-License-Identifier: MIT OR Apache-2.0
//! The evaluation's report.

use super::{Fields, Kind::*, check_row, judge};
use crate::steps::Outcome;
use std::path::Path;

const PAPER_ROW: Fields = &[
    (Text, "system variant topic"),
    (Count, "runs n misses lost steal_ticks"),
    (Number, "p50_ms p99_ms max_ms p99_std_ms rta_ms deadline_ms"),
];

/// The evaluation's report: a list of rows, each with measurements; in real time, where one thread serves all topics the
/// fastest miss deadlines, and a queue that is too short loses messages, or the measurement cannot fail.
pub fn check_paper(path: &Path, realtime: bool) -> Outcome {
    judge(path, |report| {
        let rows = report.as_array().ok_or("it is not a list")?;
        rows.iter().try_for_each(|row| check_row(row, PAPER_ROW))?;
        let variant = |name: &'static str| rows.iter().filter(move |row| row["variant"] == name);
        for name in ["futures", "futures-rt", "tokio", "nort-tokio", "futures-rt-mw-below"] {
            if variant(name).count() != 5 {
                return Err(format!("{name} has {} topics instead of 5", variant(name).count()));
            }
        }
        if !realtime {
            return Ok(());
        }
        if let Some(row) = variant("futures").take(3).find(|row| row["misses"] == 0) {
            return Err(format!("no deadline was missed: {row}"));
        }
        if variant("capacity-15").all(|row| row["lost"] == 0) {
            return Err("a queue of 15 lost nothing where 16 are needed".to_owned());
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reports::tests::refusal;
    use serde_json::Value;
    use serde_json::json;

    /// The evaluation's report as it must be, with `change` made to every row.
    fn paper_report(change: impl Fn(&mut Value)) -> String {
        let row = |variant: &str, topic: &str, misses: u64, lost: u64| {
            json!({"system": "tautline", "variant": variant, "topic": topic, "runs": 1, "n": 9, "p50_ms": 1.0, "p99_ms": 2.0,
                   "max_ms": 3.0, "p99_std_ms": 0.0, "rta_ms": 2.0, "deadline_ms": 10.0, "misses": misses, "lost": lost,
                   "steal_ticks": 0})
        };
        let topics = ["topic1", "topic2", "topic3", "topic4", "topic5"];
        let mut rows = vec![row("capacity-15", "goal", 0, 0), row("capacity-15", "scan", 0, 8)];
        for variant in ["futures", "futures-rt", "tokio", "nort-tokio", "futures-rt-mw-below"] {
            rows.extend(topics.map(|topic| row(variant, topic, 4, 0)));
        }
        rows.iter_mut().for_each(change);
        refusal(|path| check_paper(path, true), &Value::from(rows))
    }

    #[test]
    fn an_evaluation_that_cannot_fail_is_refused() {
        assert_eq!(paper_report(|_| {}), "");
        assert!(paper_report(|row| row["misses"] = json!(0)).contains("no deadline was missed"));
        assert!(paper_report(|row| row["lost"] = json!(0)).contains("queue of 15 lost nothing"));
        assert!(paper_report(|row| row["variant"] = json!("futures")).contains("instead of 5"));
        let nameless = paper_report(|row| drop(row.as_object_mut().unwrap().remove("rta_ms")));
        assert!(nameless.ends_with("has no field 'rta_ms'"));
    }
}
