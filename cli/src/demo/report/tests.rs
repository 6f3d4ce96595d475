// SPDX-License-Identifier: MIT OR Apache-2.0
use super::*;
use crate::demo::text::write_text;
use tautline_analysis::taken::{Seen, Taken};

/// The five topics, with latencies as given by `latencies_ms`.
fn report(latencies_ms: [&[f64]; 5]) -> DemoReport {
    report_with(latencies_ms, &[])
}

/// And with what the host took: from where to where in ms, all of it.
fn report_with(latencies_ms: [&[f64]; 5], taken_ms: &[(f64, f64)]) -> DemoReport {
    report_of(latencies_ms, &times(taken_ms, Seen::Running))
}

fn times(from_to_ms: &[(f64, f64)], seen: Seen) -> TakenTimes {
    let ns = |ms: f64| (ms * 1e6).round() as u64;
    TakenTimes::new(from_to_ms.iter().map(|&(from, to)| Taken {
        from_ns: ns(from),
        to_ns: ns(to),
        length_ns: ns(to - from),
        seen,
    }))
}

fn report_of(latencies_ms: [&[f64]; 5], lost_time: &TakenTimes) -> DemoReport {
    let taken = lost_time.seen(&[Seen::Running]);
    let (taken_running_ms, longest_taken_ms) = (ms(taken.total_ns()), ms(taken.longest_ns()));
    let others_ms = ms(lost_time.seen(&[Seen::Waited]).total_ns());
    let costs = Costs { per_message: Duration::from_micros(60), taken, ..Costs::default() };
    let set = [(10, 2), (20, 4), (50, 5), (100, 15), (200, 50)];
    let span = Duration::from_millis;
    let run = |(i, ((period, wcet), latencies)): (usize, ((u64, u64), &[f64]))| TopicRun {
        task: Task::new(format!("topic{}", i + 1), span(period), span(wcet), 20 - i as u8),
        releases_ns: (0..latencies.len() as u64).map(|release| release * period * 1_000_000).collect(),
        latencies_ns: latencies.iter().map(|ms| (ms * 1e6).round() as u64).collect(),
        lost: 0,
        max_queue: 1,
        lost_time: lost_time.clone(),
    };
    let runs = set.into_iter().zip(latencies_ms).enumerate().map(run).collect();
    let topics = topic_reports(runs, &costs);
    DemoReport { taken_running_ms, longest_taken_ms, others_ms, ..of_topics(topics) }
}

/// A run of 20 s from which the host took nothing.
pub fn of_topics(topics: Vec<TopicReport>) -> DemoReport {
    DemoReport {
        realtime: true,
        core: 1,
        seconds: 20.0,
        steal_ticks: 0,
        kernel: "6.1.0".into(),
        topics,
        preemption: "PREEMPT_RT".into(),
        overhead_us: 60.0,
        sampler_priority: 25,
        interruption_us: 40.0,
        interrupted_percent: 0.5,
        longest_interruption_us: 60.0,
        taken_running_ms: 0.0,
        taken_late_ms: 0.0,
        longest_taken_ms: 0.0,
        others_ms: 0.0,
        longest_use_us: 75.0,
        moments_overwritten: 0,
    }
}

fn good() -> DemoReport {
    report([&[2.1, 2.05], &[6.1], &[13.1], &[36.2], &[173.5]])
}

fn text(report: &DemoReport, verbose: bool, colour: bool) -> String {
    let mut out = Vec::new();
    write_text(report, verbose, &mut out).unwrap();
    crate::print::painted(&String::from_utf8(out).unwrap(), colour)
}

/// With all details and without line breaks, which may be between any two words.
fn prose(report: &DemoReport) -> String {
    text(report, true, false).replace('\n', " ")
}

/// Below the table, without line breaks.
fn summary(report: &DemoReport) -> String {
    let out = text(report, false, false);
    out.split_once("\n\n").unwrap().1.trim_end().replace('\n', " ")
}

#[test]
fn prediction_is_that_of_the_analysis() {
    let tasks: Vec<_> = {
        let ms = Duration::from_millis;
        vec![Task::new("a", ms(10), ms(2), 20), Task::new("b", ms(20), ms(17), 19)]
    };
    let found = predict(&tasks, &Costs { per_message: Duration::from_millis(1), ..Costs::default() });
    let bounds = |ns: [u64; 3]| {
        let [rta_ns, rta_overhead_ns, rta_host_ns] = ns.map(Some);
        Prediction { rta_ns, rta_overhead_ns, rta_host_ns }
    };
    assert_eq!(found[0], bounds([2_000_000, 4_000_000, 4_000_000]));
    assert_eq!(found[1], Prediction::default());
}

#[test]
fn percentiles_are_exact() {
    let samples: Vec<u64> = (1..=200).collect();
    assert_eq!([50, 99, 100].map(|p| percentile(&samples, p)), [Some(100), Some(198), Some(200)]);
    assert_eq!([50, 99, 100].map(|p| percentile(&[7], p)), [Some(7); 3]);
    assert_eq!(percentile(&[], 99), None);
}

#[test]
fn json_keeps_its_contract() {
    let mut out = Vec::new();
    write_json(&good(), &mut out).unwrap();
    let out = String::from_utf8(out).unwrap();
    let expected = r#"{"realtime":true,"core":1,"seconds":20.0,"steal_ticks":0,"kernel":"6.1.0","topics":[{"topic":"topic1","period_ms":10.0,"wcet_ms":2.0,"priority":20,"n":2,"p50_ms":2.05,"p99_ms":2.1,"max_ms":2.1,"rta_ms":2.0,"rta_overhead_ms":2.3,"deadline_misses":0,"lost":0,"max_queue":1,"#;
    assert!(out.starts_with(expected), "{out}");
    assert!(out.ends_with("}\n") && !out.contains("latencies"), "{out}");
}

#[test]
fn table_lines_up_and_says_that_all_is_well() {
    let out = text(&good(), false, false);
    let rows: Vec<_> = out.lines().take(8).collect();
    assert_eq!(
        rows,
        [
            "topic   period  wcet  prio  n     p50     p99     max     RTA      RTA+    RTA+  late  lost    max",
            "            ms    ms               ms      ms      ms      ms  overhead    host              queue",
            "───────────────────────────────────────────────────────────────────────────────────────────────────",
            "topic1      10     2    20  2    2.05    2.10    2.10    2.00      2.30    2.30     0     0      1",
            "topic2      20     4    19  1    6.10    6.10    6.10    6.00      6.30    6.30     0     0      1",
            "topic3      50     5    18  1   13.10   13.10   13.10   13.00     13.36   13.36     0     0      1",
            "topic4     100    15    17  1   36.20   36.20   36.20   36.00     36.54   36.54     0     0      1",
            "topic5     200    50    16  1  173.50  173.50  173.50  170.00    174.04  174.04     0     0      1",
        ]
    );
    assert!(out.contains("All deadlines met: 6 messages, none late, none lost.\n"), "{out}");
    assert!(prose(&good()).contains("Kernel 6.1.0, preemption PREEMPT_RT."), "{out}");
    assert!(out.lines().all(|line| line.chars().count() <= 100), "{out}");
}

#[test]
fn a_run_without_a_fault_ends_with_four_statements() {
    assert_eq!(
        summary(&good()),
        "All deadlines met: 6 messages, none late, none lost. \
         Prediction held; closest: topic5, 99.7 % of its bound. \
         The host took 0.00 ms of the core (longest 0.00 ms), other threads 0.00 ms; steal 0 ticks. \
         Next: `taut init robot.toml`; `taut check robot.toml` computes bounds, `taut report` verifies them."
    );
}

#[test]
fn a_run_with_a_fault_ends_with_its_cause() {
    let mut report = report([&[2.1, 12.5], &[6.1], &[13.1], &[36.2], &[173.5]]);
    report.sampler_priority = 15;
    report.steal_ticks = 3;
    assert_eq!(
        summary(&report),
        "One deadline missed: topic1 (1 of 2). Prediction exceeded: topic1 (1 of 2). \
         The host took 0.00 ms of the core (longest 0.00 ms), other threads 0.00 ms; steal 3 ticks. \
         The sampler has priority 15, the callbacks have up to 20: while a callback runs, the sampler does not, and no other callback \
         is woken. The prediction assumes a sampler above all callbacks."
    );
}

#[test]
fn misses_are_named_and_explained() {
    let mut report = report([&[2.1, 12.5], &[6.1], &[13.1], &[36.2], &[201.0]]);
    let out = prose(&report);
    assert!(out.contains("2 deadlines missed: topic1 (1 of 2), topic5 (1 of 1). "), "{out}");
    assert!(
        out.contains("Above RTA+overhead: topic1 once (12.50 ms, of which the host took 0.00 ms, other threads 0.00 ms and the middleware 0.00 ms; predicted 2.30 ms, with that 2.30 ms), topic5"),
        "{out}"
    );
    assert!(out.contains("Neither the host, nor other threads, nor the middleware used the time"), "{out}");

    report.steal_ticks = 3;
    let out = prose(&report);
    assert!(out.contains("gave 30 ms of processor time to other guests"), "{out}");

    report.realtime = false;
    let out = prose(&report);
    assert!(
        out.contains("no bound applies")
            && out.contains("the banner above names")
            && !out.contains("Prediction")
            && !out.contains("Above"),
        "{out}"
    );
}

#[test]
fn what_the_host_took_explains_a_response_or_it_does_not() {
    // Released at 10 ms; 3 ms were taken from it.
    let latencies =
        |late: f64| report_with([&[2.1, late], &[6.1], &[13.1], &[36.2], &[173.5]], &[(11.0, 14.0)]);
    let report = latencies(5.2);
    let topic = &report.topics[0];
    assert_eq!((topic.beyond, topic.unexplained, topic.rta_host_ms), (1, 0, Some(5.3)));
    let out = prose(&report);
    assert!(
        out.contains(
            "Above RTA+overhead: topic1 once (5.20 ms, of which the host took 3.00 ms, other threads 0.00 ms and the middleware 0.00 ms; predicted 2.30 ms, with that 5.30 ms)."
        ),
        "{out}"
    );
    assert!(out.contains("3.00 ms while threads ran") && out.contains("(longest 3.00 ms)"), "{out}");
    let held = "Prediction held with what others took (one response); closest: topic5, 99.7 % of its bound.";
    assert!(out.contains(held), "{out}");

    // More than what was taken, which is known to 0.1 ms: a defect.
    assert_eq!(latencies(5.4).topics[0].unexplained, 0);
    let report = latencies(5.5);
    assert_eq!((report.topics[0].beyond, report.topics[0].unexplained), (1, 1));
    let out = prose(&report);
    assert!(
        out.contains("Prediction exceeded: topic1 (1 of 2).")
            && out.contains("topic1 once (5.50 ms, of which the host took 3.00 ms,"),
        "{out}"
    );
    assert!(out.contains("look for interrupts"), "{out}");

    // Taken after it had ended: a defect, whatever the longest piece of the run would allow.
    let report = report_with([&[5.2], &[6.1], &[13.1], &[36.2], &[173.5]], &[(30.0, 33.0)]);
    assert_eq!((report.topics[0].unexplained, report.topics[0].rta_host_ms), (1, Some(5.3)));
}

#[test]
fn what_others_had_and_the_middleware_used_explains_a_response() {
    let latencies: [&[f64]; 5] = [&[2.1, 5.2], &[6.1], &[13.1], &[36.2], &[173.5]];
    // All that the middleware used takes the place of its mean.
    let used = |from_to_ms: &[(f64, f64)]| {
        report_of(latencies, &times(from_to_ms, Seen::Overran)).topics.swap_remove(0)
    };
    let topic = used(&[(9.0, 10.0), (11.0, 14.1)]);
    assert_eq!((topic.unexplained, topic.worst.unwrap().middleware_used_ms), (0, 3.1));
    // What it used until the job before ended, at 2.1 ms, has delayed nobody after; what that job did afterwards may have.
    assert_eq!(used(&[(0.5, 2.103), (11.0, 13.0)]).unexplained, 1);

    let report = report_of(latencies, &times(&[(11.0, 14.0)], Seen::Waited));
    let worst = report.topics[0].worst.unwrap();
    assert_eq!((report.topics[0].unexplained, worst.others_had_ms), (0, 3.0));
    assert_eq!(report.topics[0].rta_host_ms, report.topics[0].rta_overhead_ms, "it is not the host's");
    let out = prose(&report);
    assert!(out.contains(", other threads 3.00 ms;") && out.contains("move them to another core"), "{out}");
}

#[test]
fn notes_that_were_lost_are_told() {
    let mut report = good();
    report.moments_overwritten = 7;
    assert!(prose(&report).contains("7 records of time that was taken"), "{}", prose(&report));
}

#[test]
fn a_silent_topic_a_lossy_one_and_an_overloaded_core_are_explained() {
    let silent = report([&[2.1], &[], &[13.1], &[36.2], &[173.5]]);
    let out = prose(&silent);
    assert!(out.contains("No verdict") && out.contains("Nothing arrived on topic2: "), "{out}");
    assert_eq!(silent.topics[1].p99_ms, None);

    let mut lossy = good();
    lossy.topics[0].lost = 4;
    lossy.topics[4].rta_overhead_ms = None;
    lossy.preemption = "voluntary".into();
    let out = prose(&lossy);
    assert!(out.contains("4 messages lost: topic1 (4)"), "{out}");
    assert!(out.contains("No prediction for topic5") && out.contains("preempt=full"), "{out}");
}

#[test]
fn colour_is_opt_in() {
    let late = report([&[12.5], &[6.1], &[13.1], &[36.2], &[173.5]]);
    assert!(!text(&late, true, false).contains('\x1b'));
    let out = text(&late, false, true);
    let red: Vec<_> = out.lines().filter(|line| line.starts_with("\x1b[31m")).collect();
    assert_eq!(red.len(), 3, "the row and two verdicts: {out}");
    assert!(text(&good(), false, true).contains("\x1b[32mAll deadlines met"));
}
