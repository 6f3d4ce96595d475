// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut trace hops`: the latency of each hop of the messages of several domains.

use super::file;
use super::latency::{cell, histogram};
use super::output::write_to;
use super::recording::{Entry, Recording};
use super::ways::{At, Hop, HopKind, Place, Ways};
use crate::table::write_table;
use crate::times::us;
use crate::verb::Outcome;
use clap::Args;
use hdrhistogram::Histogram;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Prints the latency of each hop of messages, also through gateways and bridges
///
/// Give the recordings of all domains that the messages passed: record each with a separate `taut trace record` on
/// its host. Recordings of one host share a clock. Clocks of different hosts differ: hops within a host have latencies,
/// hops between hosts are only counted. `send` is when a gateway or bridge is about to hand a message to the
/// network, so `send to receive` contains both the sending and the network. Times are in microseconds.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut trace record --domain 1 --seconds 10 -o a.trace &    on the first host
  taut trace record --domain 2 --seconds 10 -o b.trace      on the second host, or on the same one
  taut trace hops a.trace b.trace                           a table of every hop, by topic
  taut trace hops a.trace b.trace --json | jq '.hops[] | {topic, hop, n, p99_us}'")]
pub struct HopsArgs {
    /// The recordings
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
}

/// The same hop of messages of one topic, between the same processes.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct RowKey<'r> {
    topic: &'r str,
    /// Whole paths come last.
    is_whole: bool,
    domains_before: usize,
    kind: HopKind,
    from: Place,
    to: Place,
}

struct Row {
    /// Empty if the clocks differ.
    latency: Histogram<u64>,
    clocks_differ: bool,
    n: u64,
    /// Hops that end before they begin: the recordings claim one clock, but have two.
    reversed: u64,
}

/// The content of the output.
struct Hops<'r> {
    rows: BTreeMap<RowKey<'r>, Row>,
    /// Hops whose beginnings are in no recording.
    unmatched: BTreeMap<(&'r str, HopKind, Place), u64>,
}

pub fn run(args: &HopsArgs, json: bool) -> Outcome {
    let recordings = args.files.iter().map(|path| file::read(path)).collect::<Result<Vec<_>, _>>()?;
    let hops = hops(&recordings);
    write_to(Path::new("-"), |to| {
        if json {
            writeln!(to, "{}", to_json(&args.files, &recordings, &hops))
        } else {
            table(&recordings, &hops, to)
        }
    })?;
    if !json {
        warnings(&args.files, &recordings).for_each(|warning| eprintln!("taut: warning: {warning}"));
    }
    Ok(())
}

fn warnings(files: &[PathBuf], recordings: &[Recording]) -> impl Iterator<Item = String> {
    let of_file = |(file, recording): (&PathBuf, &Recording)| {
        let name = |warning: &String| format!("{}: {warning}", file.display());
        recording.warnings.iter().map(name).collect::<Vec<_>>()
    };
    files.iter().zip(recordings).flat_map(of_file)
}

/// The domain, the host's name and the identifier of its clock.
fn session(recording: &Recording) -> (Option<u32>, &str, &str) {
    match &recording.session {
        Some(Entry::Session { domain, host, clock, .. }) => (Some(*domain), host, clock),
        _ => (None, "", ""),
    }
}

/// For each recording the index of the first recording with the same clock.
fn clocks(recordings: &[Recording]) -> Vec<usize> {
    let clock = |recording| session(recording).2;
    let first = |(index, of)| {
        recordings
            .iter()
            .position(|other| !clock(of).is_empty() && clock(of) == clock(other))
            .unwrap_or(index)
    };
    recordings.iter().enumerate().map(first).collect()
}

fn hops(recordings: &[Recording]) -> Hops<'_> {
    let clocks = clocks(recordings);
    let is_one_clock = |a: Place, b: Place| clocks.get(a.recording) == clocks.get(b.recording);
    // Times of different clocks cannot be compared.
    let is_before = |a: At, b: At| !is_one_clock(a.place, b.place) || a.time_ns <= b.time_ns;
    let mut hops = Hops { rows: BTreeMap::new(), unmatched: BTreeMap::new() };
    Ways::of(recordings).hops(&is_before, &mut |hop: Hop<'_>| {
        let Hop { topic, domains_before, kind, from, to } = hop;
        let Some(from) = from else {
            *hops.unmatched.entry((topic, kind, to.place)).or_default() += 1;
            return;
        };
        let is_whole = kind == HopKind::WholeWay;
        let key = RowKey { topic, is_whole, domains_before, kind, from: from.place, to: to.place };
        let row = hops.rows.entry(key).or_insert_with(|| Row {
            latency: histogram(),
            clocks_differ: !is_one_clock(from.place, to.place),
            n: 0,
            reversed: 0,
        });
        row.n += 1;
        match to.time_ns.checked_sub(from.time_ns) {
            _ if row.clocks_differ => {}
            // This cannot fail, because the histogram grows to 64 bits.
            Some(latency_ns) => drop(row.latency.record(latency_ns)),
            None => row.reversed += 1,
        }
    });
    hops
}

fn place_to_json(recordings: &[Recording], place: Place) -> Value {
    let recording = recordings.get(place.recording);
    let process = recording.and_then(|recording| recording.processes.get(&place.process));
    let (domain, host, _) = recording.map_or((None, "", ""), session);
    json!({
        "recording": place.recording, "host": host, "domain": domain,
        "process": process.map(|process| &*process.name), "pid": process.map(|process| process.pid),
    })
}

fn to_json(files: &[PathBuf], recordings: &[Recording], hops: &Hops<'_>) -> Value {
    let clocks = clocks(recordings);
    let recording = |(index, recording): (usize, &Recording)| json!({"file": files.get(index).map(|file| file.display().to_string()), "session": recording.session, "clock": clocks.get(index)});
    let row = |(key, row): (&RowKey<'_>, &Row)| {
        let at = |quantile| (!row.latency.is_empty()).then(|| us(row.latency.value_at_quantile(quantile)));
        json!({
            "topic": key.topic, "hop": key.kind.name(),
            "from": place_to_json(recordings, key.from), "to": place_to_json(recordings, key.to),
            "clocks_differ": row.clocks_differ, "reversed": row.reversed,
            "n": row.n, "p50_us": at(0.5), "p99_us": at(0.99), "max_us": at(1.0),
        })
    };
    let unmatched = |((topic, kind, to), n): (&(&str, HopKind, Place), &u64)| json!({"topic": topic, "hop": kind.name(), "to": place_to_json(recordings, *to), "n": n});
    json!({
        "recordings": recordings.iter().enumerate().map(recording).collect::<Vec<_>>(),
        "hops": hops.rows.iter().map(row).collect::<Vec<_>>(),
        "unmatched": hops.unmatched.iter().map(unmatched).collect::<Vec<_>>(),
        "events_lost": recordings.iter().map(Recording::events_lost).fold(0, u64::saturating_add),
        "warnings": warnings(files, recordings).collect::<Vec<_>>(),
    })
}

fn table(recordings: &[Recording], hops: &Hops<'_>, mut to: &mut dyn Write) -> io::Result<()> {
    let head = ["topic", "hop", "where", "n", "p50 µs", "p99 µs", "max µs"];
    let mut lines = Vec::new();
    let mut topic = None;
    for (key, row) in &hops.rows {
        let is_first = topic.replace(key.topic) != Some(key.topic);
        let line = vec![
            if is_first { key.topic.to_owned() } else { String::new() },
            key.kind.name().replace('_', " "),
            places(recordings, key.from, key.to),
            row.n.to_string(),
            cell(&row.latency, 0.5),
            cell(&row.latency, 0.99),
            cell(&row.latency, 1.0),
        ];
        lines.push((true, line));
    }
    write_table(&head, 3, lines, &mut to)?;
    if hops.rows.values().any(|row| row.clocks_differ) {
        writeln!(to, "-: unknown, because the clocks of the two recordings differ")?;
    }
    for (key, row) in hops.rows.iter().filter(|(_, row)| row.reversed != 0) {
        writeln!(
            to,
            "{}, {}: {} of {} ended before they began: the clocks of the recordings are not one",
            key.topic,
            key.kind.name().replace('_', " "),
            row.reversed,
            row.n
        )?;
    }
    for ((topic, kind, place), n) in &hops.unmatched {
        let (beginning, hop) = (kind.beginning(), kind.name().replace('_', " "));
        let place = process(recordings, *place);
        writeln!(to, "{topic}, {hop}: no recording contains the {beginning} of {n} messages to {place}")?;
    }
    Ok(())
}

fn process(recordings: &[Recording], place: Place) -> String {
    let recording = recordings.get(place.recording);
    let process = recording.and_then(|recording| recording.processes.get(&place.process));
    process.map_or_else(|| "?".to_owned(), |process| format!("{} ({})", process.name, process.pid))
}

/// The process, or the two processes, with the domain or the two domains; with the hosts if there are several.
fn places(recordings: &[Recording], from: Place, to: Place) -> String {
    let host = |recording: &Recording| session(recording).1.to_owned();
    let are_hosts = recordings.iter().any(|other| Some(host(other)) != recordings.first().map(host));
    let domain = |place: Place| {
        let of = recordings.get(place.recording);
        let (domain, host, _) = of.map_or((None, "", ""), session);
        let domain = domain.map_or_else(|| "?".to_owned(), |domain| domain.to_string());
        if are_hosts { format!("domain {domain} of {host}") } else { format!("domain {domain}") }
    };
    let (process, arrow) = (|place| process(recordings, place), "→");
    match (from.recording == to.recording, from == to) {
        (_, true) => format!("{}, {}", process(from), domain(from)),
        (true, _) => format!("{} {arrow} {}, {}", process(from), process(to), domain(to)),
        _ => format!("{}, {} {arrow} {}, {}", process(from), domain(from), process(to), domain(to)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::recording::TimedEvent;
    use tautline_trace::{Description, Event, EventKind, ObjectId, ObjectKind, gid_key};

    /// What a recording says, a line per event. Objects are known by their gid's first word.
    #[derive(Default)]
    struct Script(Recording);

    impl Script {
        fn new(domain: u32, clock: &str) -> Self {
            let (taut, kernel, host) = Default::default();
            let (started_monotonic_ns, started_unix_ns, clock) = (0, 0, clock.to_owned());
            let session =
                Entry::Session { domain, taut, kernel, started_monotonic_ns, started_unix_ns, host, clock };
            Script(Recording { session: Some(session), ..Recording::default() })
        }

        fn object(mut self, process: u32, id: u64, kind: ObjectKind) -> Self {
            let (gid, name) = ([id, 0], "/x".to_owned());
            let (id, parent) = (ObjectId(id), ObjectId::NONE);
            let object = Description { id, kind, parent, detail: 0, gid, created_ns: 0, name };
            self.0.process(process).objects.insert(id, object);
            self
        }

        fn event(
            mut self,
            process: u32,
            time_ns: u64,
            kind: EventKind,
            object: u64,
            arguments: [u64; 3],
        ) -> Self {
            let event = Event { time_ns, kind, object: ObjectId(object), arguments };
            self.0.events.push(TimedEvent { process, tid: process, event });
            self
        }

        fn publish(self, process: u32, time_ns: u64, port: u64, number: u64) -> Self {
            self.event(process, time_ns, EventKind::Publish, port, [number, 0, gid_key([port, 0])])
        }

        fn take(self, process: u32, time_ns: u64, subscription: u64, port: u64, number: u64) -> Self {
            self.event(process, time_ns, EventKind::Take, subscription, [number, 0, gid_key([port, 0])])
        }

        fn receive(self, process: u32, time_ns: u64, port: u64, sender: u64, number: u64) -> Self {
            self.event(process, time_ns, EventKind::Receive, port, [number, 0, gid_key([sender, 0])])
        }

        fn pass(self, process: u32, time_ns: u64, through: (u64, u64), from: (u64, u64)) -> Self {
            let ((object, number), (from, from_number)) = (through, from);
            self.event(process, time_ns, EventKind::Pass, object, [number, from_number, gid_key([from, 0])])
        }
    }

    const GATEWAY: u32 = 1;
    const BRIDGE: u32 = 2;

    /// A message from domain 1 by gateways to 2, and by bridges on to 3, with a number of its own in each port.
    fn three_domains(clocks: [&str; 3]) -> Vec<Recording> {
        let [a, b, c] = clocks;
        let first = Script::new(1, a).object(0, 10, ObjectKind::Publisher).object(1, 11, ObjectKind::Sender);
        let first = first.publish(0, 100, 10, 5).take(1, 103, 20, 10, 5).take(0, 104, 21, 10, 5);
        let first = first.pass(GATEWAY, 110, (11, 5), (10, 5));
        let second = Script::new(2, b).object(1, 12, ObjectKind::Publisher).object(2, 13, ObjectKind::Sender);
        let second = second.receive(GATEWAY, 130, 12, 11, 5).pass(GATEWAY, 135, (12, 1), (11, 5));
        let second = second.publish(GATEWAY, 136, 12, 1).take(BRIDGE, 140, 22, 12, 1);
        // The gateway's own subscription gets what comes through its own port.
        let second =
            second.take(GATEWAY, 141, 23, 12, 1).take(0, 145, 24, 12, 1).pass(BRIDGE, 150, (13, 9), (12, 1));
        let third = Script::new(3, c).object(2, 14, ObjectKind::Publisher);
        let third = third.receive(BRIDGE, 170, 14, 13, 9).pass(BRIDGE, 171, (14, 2), (13, 9));
        let third = third.publish(BRIDGE, 172, 14, 2).take(0, 180, 25, 14, 2);
        [first, second, third]
            .map(|script| {
                let mut recording = script.0;
                recording.finish();
                recording
            })
            .into()
    }

    /// Hop, from and to as recording and process, latency.
    type Told = (&'static str, (usize, u32), (usize, u32), Option<u64>);

    fn told(recordings: &[Recording]) -> Vec<Told> {
        let hops = hops(recordings);
        let place = |place: Place| (place.recording, place.process);
        let told = |(key, row): (&RowKey<'_>, &Row)| {
            assert_eq!((key.topic, row.n, row.reversed), ("/x", 1, 0));
            let latency = (!row.latency.is_empty()).then(|| row.latency.max());
            (key.kind.name(), place(key.from), place(key.to), latency)
        };
        hops.rows.iter().map(told).collect()
    }

    #[test]
    fn a_way_through_two_networks_is_told_hop_by_hop() {
        let told = told(&three_domains(["boot"; 3]));
        let expected = [
            ("publish_to_take", (0, 0), (0, 0), Some(4)),
            ("publish_to_take", (0, 0), (0, 1), Some(3)),
            ("take_to_send", (0, 1), (0, 1), Some(7)),
            ("send_to_receive", (0, 1), (1, 1), Some(20)),
            ("receive_to_publish", (1, 1), (1, 1), Some(6)),
            ("publish_to_take", (1, 1), (1, 0), Some(9)),
            ("publish_to_take", (1, 1), (1, 2), Some(4)),
            ("take_to_send", (1, 2), (1, 2), Some(10)),
            ("send_to_receive", (1, 2), (2, 2), Some(20)),
            ("receive_to_publish", (2, 2), (2, 2), Some(2)),
            ("publish_to_take", (2, 2), (2, 0), Some(8)),
            ("whole_way", (0, 0), (1, 0), Some(45)),
            ("whole_way", (0, 0), (2, 0), Some(80)),
        ];
        assert_eq!(told, expected);
    }

    #[test]
    fn between_clocks_that_differ_no_time_is_told() {
        // The second recording's host is not that of the others; of a recording without a clock nothing is known.
        for clocks in [["one", "other", "one"], ["one", "", "one"]] {
            let recordings = three_domains(clocks);
            let told = told(&recordings);
            assert_eq!(told.len(), 13);
            for (hop, from, to, latency) in told {
                let is_one = (from.0 == 1) == (to.0 == 1);
                assert_eq!(latency.is_some(), is_one, "{hop} from {from:?} to {to:?}");
            }
            let json = to_json(&["a", "b", "c"].map(PathBuf::from), &recordings, &hops(&recordings));
            assert_eq!(json["hops"][3]["clocks_differ"], true, "{json:#}");
            assert!(json["hops"][3]["p50_us"].is_null());
            assert_eq!(
                (&json["recordings"][1]["clock"], &json["recordings"][2]["clock"]),
                (&json!(1), &json!(0))
            );
        }
        let unknown = three_domains([""; 3]);
        assert_eq!(clocks(&unknown), [0, 1, 2]);
    }

    #[test]
    fn what_is_not_recorded_is_counted_and_no_whole_way() {
        let mut recordings = three_domains(["boot"; 3]);
        recordings.remove(0);
        let hops = hops(&recordings);
        let unmatched: Vec<_> =
            hops.unmatched.iter().map(|((_, kind, to), n)| (*kind, to.process, *n)).collect();
        assert_eq!(unmatched, [(HopKind::SendToReceive, GATEWAY, 1)]);
        assert!(hops.rows.keys().all(|key| !key.is_whole), "it began elsewhere");
        assert_eq!(hops.rows.len(), 7);
        let mut text = Vec::new();
        table(&recordings, &hops, &mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
        assert!(
            text.contains("/x, send to receive: no recording contains the sending of 1 messages to"),
            "{text}"
        );
    }

    #[test]
    fn what_nobody_counts_is_not_guessed_between_domains() {
        let first = Script::new(1, "boot").object(1, 11, ObjectKind::Sender);
        let second = Script::new(2, "boot").object(1, 12, ObjectKind::Publisher);
        let first =
            (1..=2).fold(first, |script, n| script.take(1, n, 20, 10, n).pass(1, n, (11, 0), (10, n)));
        let second = (1..=2).fold(second, |script, n| {
            let script = script.receive(1, 10 * n, 12, 11, 0).pass(1, 10 * n, (12, n), (11, 0));
            script.publish(1, 10 * n + n, 12, n)
        });
        let recordings = [first.0, second.0];
        let hops = hops(&recordings);
        let told: Vec<_> = hops.rows.iter().map(|(key, row)| (key.kind, row.n, row.latency.max())).collect();
        assert_eq!(told, [(HopKind::ReceiveToPublish, 2, 2), (HopKind::TakeToSend, 2, 0)]);
        let unmatched: Vec<_> = hops.unmatched.iter().map(|((_, kind, _), n)| (*kind, *n)).collect();
        assert_eq!(unmatched, [(HopKind::PublishToTake, 2), (HopKind::SendToReceive, 2)]);
    }

    #[test]
    fn a_damaged_recording_may_go_in_circles() {
        let circle =
            Script::new(1, "boot").object(1, 11, ObjectKind::Sender).object(1, 12, ObjectKind::Publisher);
        let circle = circle.pass(1, 10, (12, 1), (11, 1)).publish(1, 11, 12, 1).pass(1, 12, (11, 1), (12, 1));
        let recordings = [circle.take(0, 20, 13, 12, 1).0];
        assert!(hops(&recordings).rows.keys().any(|key| key.kind == HopKind::PublishToTake));
    }
}
