// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut trace` as a person or script sees it: a program records, the command fetches, exports and computes.

mod traced;

use serde_json::Value;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use traced::{MESSAGES, Program, scratch, taut, text};

/// The lines of the CSV export, each as a map from column to value.
fn csv(recording: &Path) -> Vec<HashMap<String, String>> {
    let out = taut(&["trace", "export", &recording.display().to_string(), "--format", "csv", "-o", "-"]);
    assert!(out.status.success(), "{}", text(&out.stderr));
    let text = text(&out.stdout);
    let mut lines = text.lines().map(|line| line.split(',').map(str::to_owned));
    let head: Vec<String> = lines.next().unwrap().collect();
    lines.map(|line| head.iter().cloned().zip(line).collect()).collect()
}

fn json(verb: &str, recording: &Path) -> Value {
    let out = taut(&["trace", verb, &recording.display().to_string(), "--json"]);
    assert!(out.status.success(), "{}", text(&out.stderr));
    serde_json::from_slice(&out.stdout).unwrap()
}

#[test]
fn talker_and_listener_in_the_order_of_their_events() {
    let Some(run) = Program::new("talker_and_listener_in_the_order_of_their_events", 123).run() else {
        return;
    };
    let (sampler, others): (Vec<_>, Vec<_>) =
        csv(&run.recording).into_iter().partition(|line| line["event"].starts_with("spin_"));
    let shown: Vec<String> = others
        .iter()
        .map(|line| {
            format!("{} {} {}", line["event"], line["object"], line["sequence_number"]).trim_end().to_owned()
        })
        .collect();
    let mut expected: Vec<String> = [
        "context_init domain 123",
        "sampler_init sampler",
        "node_init /traced",
        "publisher_init /traced/numbers",
        "subscription_init /traced/numbers",
        "callback_init /traced/numbers",
        "callback_init numbers",
    ]
    .map(str::to_owned)
    .into();
    for number in 1..=MESSAGES {
        expected.push(format!("publish /traced/numbers {number}"));
        expected.push(format!("take /traced/numbers {number}"));
        expected.push("callback_start /traced/numbers".to_owned());
        expected.push("callback_end /traced/numbers".to_owned());
    }
    assert_eq!(shown, expected);
    let threads = others.iter().filter(|line| line["event"] == "take").map(|line| line["thread"].as_str());
    assert!(threads.eq(std::iter::repeat_n("cb:numbers", MESSAGES)));

    // The sampler waits, wakes, serves; or waits in vain.
    let kinds: Vec<&str> = sampler.iter().map(|line| line["event"].as_str()).collect();
    assert!(sampler.iter().all(|line| line["thread"] == "sampler"));
    let mut before = "spin_end";
    for kind in kinds {
        let allowed: &[&str] = match before {
            "spin_start" => &["spin_wake", "spin_timeout"],
            "spin_wake" => &["spin_end"],
            _ => &["spin_start"],
        };
        assert!(allowed.contains(&kind), "{kind} after {before}");
        before = kind;
    }
}

#[test]
fn latencies_are_of_every_message() {
    let Some(run) = Program::new("latencies_are_of_every_message", 124).run() else { return };
    let latency = json("latency", &run.recording);
    assert_eq!(latency["events_lost"], 0);
    let [callback] = latency["callbacks"].as_array().unwrap().as_slice() else { panic!("{latency:#}") };
    assert_eq!(callback["topic"], "/traced/numbers");
    assert_eq!((callback["n"].as_u64(), callback["unmatched"].as_u64()), (Some(MESSAGES as u64), Some(0)));
    assert_eq!(callback["messages_lost"], 0);
    let at = |what: &str, quantile: &str| callback[what][quantile].as_f64().unwrap();
    for what in ["publish_to_start", "publish_to_end", "duration"] {
        assert_eq!(callback[what]["n"], MESSAGES);
        assert!(0.0 < at(what, "p50_us") && at(what, "p50_us") <= at(what, "p99_us"), "{callback:#}");
        assert!(at(what, "p99_us") <= at(what, "p99_9_us") && at(what, "p99_9_us") <= at(what, "max_us"));
    }
    assert!(at("publish_to_start", "p50_us") <= at("publish_to_end", "p50_us"));
    let table = text(&taut(&["trace", "latency", &run.recording.display().to_string()]).stdout);
    assert!(table.contains("publish to start") && table.contains("/traced/numbers"), "{table}");
}

#[test]
fn the_perfetto_export_has_slices_threads_and_arrows() {
    let Some(run) = Program::new("the_perfetto_export_has_slices_threads_and_arrows", 126).run() else {
        return;
    };
    let recording = run.recording.display().to_string();
    let out = taut(&["trace", "export", &recording]);
    assert!(out.status.success(), "{}", text(&out.stderr));
    let exported: Value =
        serde_json::from_slice(&std::fs::read(format!("{recording}.json")).unwrap()).unwrap();
    let events = exported["traceEvents"].as_array().unwrap();
    let with = |key: &str, value: &str| events.iter().filter(|event| event[key] == value).collect::<Vec<_>>();

    let names: BTreeMap<u64, &str> = with("name", "thread_name")
        .iter()
        .map(|event| (event["tid"].as_u64().unwrap(), event["args"]["name"].as_str().unwrap()))
        .collect();
    let mut threads: Vec<&str> = names.values().copied().collect();
    threads.sort_unstable();
    assert!(threads.contains(&"cb:numbers") && threads.contains(&"sampler"), "{threads:?}");
    let callbacks = with("cat", "callback");
    assert_eq!(callbacks.len(), MESSAGES);
    assert!(callbacks.iter().all(|slice| slice["ph"] == "X" && slice["dur"].as_f64().unwrap() > 0.0));
    assert!(callbacks.iter().all(|slice| names[&slice["tid"].as_u64().unwrap()] == "cb:numbers"));

    // Each arrow goes from the slice of a publication to the slice of its callback.
    let ends = |ph: &str| -> BTreeMap<u64, (&Value, &Value)> {
        with("ph", ph)
            .into_iter()
            .map(|end| (end["id"].as_u64().unwrap(), (&end["tid"], &end["ts"])))
            .collect()
    };
    let (starts, finishes) = (ends("s"), ends("f"));
    assert_eq!((starts.len(), finishes.len()), (MESSAGES, MESSAGES));
    let slices = |category: &str| -> Vec<(&Value, &Value)> {
        with("cat", category).into_iter().map(|slice| (&slice["tid"], &slice["ts"])).collect()
    };
    let (publications, callbacks) = (slices("publish"), slices("callback"));
    for (id, from) in &starts {
        assert!(publications.contains(from), "arrow {id} begins at no publication");
        assert!(callbacks.contains(&finishes[id]), "arrow {id} ends at no callback");
        assert!(from.1.as_f64() < finishes[id].1.as_f64());
    }
    let times: Vec<f64> = events.iter().filter_map(|event| event["ts"].as_f64()).collect();
    assert!(times.is_sorted(), "in order of time");
}

#[test]
fn a_small_ring_loses_events_and_says_how_many() {
    let program = Program::new("a_small_ring_loses_events_and_says_how_many", 127);
    let Some(run) = program.variable("TAUT_TRACE_EVENTS", "16").run() else { return };
    let lost = run.report["events_lost"].as_u64().unwrap();
    // The callback's thread alone has three events per message.
    assert!(lost >= 3 * MESSAGES as u64 - 16, "{}", run.report);
    let latency = json("latency", &run.recording);
    assert_eq!(latency["events_lost"].as_u64(), Some(lost));
    assert!(latency["callbacks"][0]["messages_lost"].is_null(), "what it took is not known: {latency:#}");
    assert!(latency["warnings"][0].as_str().unwrap().contains("TAUT_TRACE_EVENTS"), "{latency:#}");
    let lines = csv(&run.recording);
    let of_callback = lines.iter().filter(|line| line["thread"] == "cb:numbers").count();
    assert_eq!(of_callback, 16, "the newest");
}

#[test]
fn overwritten_messages_are_counted_as_the_subscription_does() {
    let program = Program::new("overwritten_messages_are_counted_as_the_subscription_does", 159);
    let Some(run) = program.variable("TAUT_TEST_BURST", "1").run() else { return };
    let latency = json("latency", &run.recording);
    let callback = &latency["callbacks"][0];
    let said: u64 =
        run.said.lines().find_map(|line| line.split_once("lost=")?.1.trim().parse().ok()).unwrap();
    assert!(said > 0, "{}", run.said);
    assert_eq!(callback["messages_lost"].as_u64(), Some(said), "{latency:#}");
}

#[test]
fn what_is_no_recording_is_refused_by_name() {
    let directory = scratch("no-recording");
    let file = directory.join("notes.txt");
    std::fs::write(&file, "nothing\n").unwrap();
    for verb in ["latency", "export"] {
        let out = taut(&["trace", verb, &file.display().to_string()]);
        assert_eq!(out.status.code(), Some(2));
        let complaint = text(&out.stderr);
        assert!(complaint.contains("notes.txt` is not a recording: it does not begin as one"), "{complaint}");
    }
    let out = taut(&["trace", "--domain", "231", "latency", &file.display().to_string()]);
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("--domain goes with `taut trace record`"));
    let out = taut(&["trace", "--domain", "231", "record", "--seconds", "0", "-o", "/nowhere/run.trace"]);
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("`/nowhere/run.trace` cannot be written"));
    std::fs::remove_dir_all(directory).unwrap();
}

#[test]
fn a_groups_callbacks_start_at_their_turn_under_their_topics() {
    let program = Program::new("a_groups_callbacks_start_at_their_turn_under_their_topics", 125);
    let Some(run) = program.variable("TAUT_TEST_GROUP", "1").run() else { return };
    let lines = csv(&run.recording);
    let of_group: Vec<String> = lines
        .iter()
        .filter(|line| line["thread"] == "cb:group")
        .map(|line| format!("{} {}", line["event"], line["object"].rsplit('/').next().unwrap()))
        .collect();
    let expected = [
        "take first",
        "take second",
        "callback_start first",
        "callback_end first",
        "callback_start second",
        "callback_end second",
    ];
    assert_eq!(of_group, expected);
    let latency = json("latency", &run.recording);
    let unmatched = latency["callbacks"].as_array().unwrap().iter().map(|row| row["unmatched"].as_u64());
    assert_eq!(unmatched.collect::<Vec<_>>(), [Some(0), Some(0)]);
}
