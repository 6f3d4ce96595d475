// SPDX-License-Identifier: MIT OR Apache-2.0
use std::time::Duration;

use tautline_analysis::Task;

use super::*;
use crate::demo::report::tests::of_topics;
use crate::demo::report::{Costs, TopicRun, topic_reports};

fn topic(latencies_ms: &[f64]) -> TopicReport {
    let task = Task::new("topic<1>", Duration::from_millis(10), Duration::from_millis(2), 20);
    let latencies_ns = latencies_ms.iter().map(|ms| (ms * 1e6) as u64).collect();
    let (releases_ns, lost_time) = Default::default();
    let run = TopicRun { task, releases_ns, latencies_ns, lost: 0, max_queue: 1, lost_time };
    topic_reports(vec![run], &Costs { per_message: Duration::from_micros(60), ..Costs::default() }).remove(0)
}

#[test]
fn bins_keep_every_sample_and_split_at_the_deadline() {
    let bins = Bins::new(&topic(&[2.0, 2.1, 10.0, 10.001, 39.0, 45.0, 12_425.0]), 170);
    assert_eq!(bins.counts.iter().sum::<u64>(), 7);
    assert_eq!(bins.counts[..bins.on_time].iter().sum::<u64>(), 3, "at the deadline is on time");
    assert_eq!(bins.beyond, 2);
    assert!((bins.bin_ms * bins.on_time as f64 - 10.0).abs() < 1e-9);
    assert!(bins.end_ms() >= 40.0 && bins.end_ms() < 42.0, "{}", bins.end_ms());
}

#[test]
fn axis_ends_slightly_past_deadline_or_longest() {
    for (longest, from, to) in [(2.0, 10.3, 11.0), (13.0, 13.4, 14.2)] {
        let end = Bins::new(&topic(&[longest]), 170).end_ms();
        assert!((from..to).contains(&end), "{longest}: {end}");
    }
}

#[test]
fn steps_are_round() {
    assert_eq!([1.3, 2.7, 0.9, 6.6, 26.0].map(round_step), [1.0, 2.0, 1.0, 5.0, 20.0]);
}

#[test]
fn svg_is_whole_and_names_everything_once() {
    let svg = render_svg(&of_topics(vec![topic(&[2.0, 12.0])])).unwrap();
    assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"), "{svg}");
    for words in ["topic&lt;1&gt;", "predicted 2.06 ms", "1 late", "p99 12.00", "Linux 6.1.0 (PREEMPT_RT)"] {
        assert_eq!(svg.matches(words).count(), 1, "{words}: {svg}");
    }
    assert!(svg.contains("font-family=\"sans-serif\"") && !svg.contains("off scale"));
}

#[test]
fn odd_reports_are_drawn_too() {
    let mut odd = vec![topic(&[]), topic(&[12_425.0; 3]), topic(&[2.0; 100_000])];
    odd[1].rta_overhead_ms = None;
    odd.push(TopicReport { deadline_ms: 0.0, period_ms: 0.0, ..topic(&[1.0]) });
    odd.push(TopicReport {
        topic: "/a/very/long/name/of/a/topic".into(),
        lost: u64::MAX,
        ..topic(&[1e9; 3])
    });
    let mut report = of_topics(odd);
    report.realtime = false;
    report.kernel = "k".repeat(500);
    let svg = render_svg(&report).unwrap();
    for words in
        ["no message received", "no bound", "3 off scale", "not real-time", "kkk…", "/a/very/long/name/o…"]
    {
        assert!(svg.contains(words), "{words}: {svg}");
    }
    report.topics.clear();
    assert!(render_svg(&report).unwrap_err().to_string().contains("no topics"));
}
