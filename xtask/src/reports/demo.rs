// SPDX-License-Identifier: MIT OR Apache-2.0
//! The demo's report.

use super::{Fields, Kind::*, check_fields, check_row, judge};
use crate::steps::Outcome;
use std::path::Path;

const DEMO: Fields = &[
    (Bool, "realtime"),
    (Count, "core steal_ticks"),
    (Number, "seconds"),
    (Text, "kernel"),
    (List, "topics"),
];

const DEMO_TOPIC: Fields = &[
    (Text, "topic"),
    (Number, "period_ms wcet_ms p50_ms p99_ms max_ms rta_ms rta_overhead_ms rta_host_ms"),
    (Count, "priority n beyond unexplained deadline_misses lost max_queue"),
];

/// The demo's report: five topics, each with messages; in real time if `realtime`.
pub fn check_demo(path: &Path, realtime: bool) -> Outcome {
    judge(path, |report| {
        check_fields(report, "the report", DEMO)?;
        if realtime && report["realtime"] != true {
            return Err("the demo ran without real-time priorities".to_owned());
        }
        let topics = report["topics"].as_array().map_or(&[][..], Vec::as_slice);
        if topics.len() != 5 {
            return Err(format!("{} topics instead of 5", topics.len()));
        }
        topics.iter().try_for_each(|topic| match check_row(topic, DEMO_TOPIC) {
            Ok(()) if topic["lost"] != 0 => Err(format!("messages were lost: {topic}")),
            checked => checked,
        })
    })
}

/// The demo's report with the sampler below the callbacks: its three fastest topics must miss deadlines, or the
/// measurement cannot fail.
pub fn check_ablation(path: &Path) -> Outcome {
    judge(path, |report| {
        check_fields(report, "the report", DEMO)?;
        let topics = report["topics"].as_array().map_or(&[][..], Vec::as_slice);
        match topics.iter().take(3).find(|topic| topic["deadline_misses"] == 0) {
            Some(topic) => Err(format!("no deadline was missed: {topic}")),
            None => Ok(()),
        }
    })
}
