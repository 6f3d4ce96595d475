// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report of the bridge's bench.

use super::{Fields, Kind::*, check_fields, judge};
use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

const BRIDGE_CPU: Fields = &[(Number, "bridge direct bridged publisher machine")];

const BRIDGE_SUBSCRIBER: Fields = &[(Count, "messages disordered"), (Number, "p50_us p99_us")];

/// The bridge's ways: all that was published came through each of them, once and in order, and what it cost is beside r2r's.
pub fn check_bridge(path: &Path, expected: u64) -> Outcome {
    judge(path, |report| {
        let ways = report.as_array().ok_or("it is not a list")?;
        let names: Vec<&Value> = ways.iter().map(|way| &way["direction"]).collect();
        if names != ["from_ros", "to_ros"] {
            return Err(format!("its ways are {names:?}"));
        }
        ways.iter().try_for_each(|way| {
            check_fields(&way["cpu"], "cpu", BRIDGE_CPU)?;
            for subscriber in ["direct", "bridged"] {
                check_fields(&way[subscriber], subscriber, BRIDGE_SUBSCRIBER)?;
            }
            let (all, got) = (&way["expected"], &way["bridged"]);
            if *all != expected || got["messages"] != *all || got["disordered"] != 0 {
                return Err(format!(
                    "{}: {expected} were expected in order, not {got} of {all}",
                    way["direction"]
                ));
            }
            Ok(())
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reports::tests::refusal;
    use serde_json::json;

    #[test]
    fn a_bridge_that_loses_or_repeats_is_refused() {
        let judged = |messages: u64, disordered: u64| {
            let subscriber =
                json!({"messages": messages, "disordered": disordered, "p50_us": 1.0, "p99_us": 2.0});
            let cpu = json!({"bridge": 1.0, "direct": 1.0, "bridged": 1.0, "publisher": 1.0, "machine": 2.0});
            let way = |name| json!({"direction": name, "expected": 9, "direct": subscriber, "bridged": subscriber, "cpu": cpu});
            let report = json!([way("from_ros"), way("to_ros")]);
            refusal(|path| check_bridge(path, 9), &report).is_empty()
        };
        assert!(judged(9, 0));
        assert!(!judged(8, 0) && !judged(9, 1) && !judged(10, 0));
    }
}
