// SPDX-License-Identifier: MIT OR Apache-2.0
//! A recording in the trace event format, which ui.perfetto.dev and chrome://tracing read: processes and threads with their
//! names, callbacks and the sampler's work as slices, an arrow from each publication to each of its callbacks.

use super::messages::{Publication, key, publications, runs};
use super::recording::Recording;
use serde_json::{Value, json};
use std::collections::HashMap;
use std::io::{self, Write};
use tautline_trace::{EventKind, ObjectId};

/// The length of a publication's slice: arrows begin only at slices. It is shorter if the thread's next event is earlier.
const PUBLISH_NS: u64 = 1_000;

/// Writes the whole recording, an event per line.
pub fn write(recording: &Recording, to: &mut dyn Write) -> io::Result<()> {
    let zero_ns = recording.events.first().map_or(0, |timed| timed.event.time_ns);
    let mut events = Vec::new();
    names(recording, &mut events);
    // Sorted: an importer binds an arrow to the slice that is open at its time.
    let mut timed = Vec::new();
    callbacks(recording, &mut timed);
    others(recording, &mut timed);
    timed.sort_by_key(|(time_ns, order, _)| (*time_ns, *order));
    events.extend(timed.into_iter().map(|(time_ns, _, mut event)| {
        event["ts"] = micros(time_ns.saturating_sub(zero_ns));
        event
    }));
    let other_data = json!({
        "session": recording.session,
        "zero_monotonic_ns": zero_ns,
        "events_lost": recording.events_lost(),
        "warnings": recording.warnings,
    });
    write!(to, "{{\"displayTimeUnit\":\"ns\",\"otherData\":{other_data},\"traceEvents\":[")?;
    for (index, event) in events.iter().enumerate() {
        write!(to, "{}\n{event}", if index == 0 { "" } else { "," })?;
    }
    writeln!(to, "\n]}}")
}

/// Microseconds with three decimals, as in the format.
fn micros(ns: u64) -> Value {
    json!(ns as f64 / 1000.0)
}

fn names(recording: &Recording, events: &mut Vec<Value>) {
    for of in recording.processes.values() {
        let pid = of.pid;
        let name = format!("{} ({pid})", of.name);
        events.push(json!({"ph": "M", "name": "process_name", "pid": pid, "args": {"name": name}}));
        for (tid, name) in &of.threads {
            events.push(
                json!({"ph": "M", "name": "thread_name", "pid": pid, "tid": tid, "args": {"name": name}}),
            );
        }
    }
}

fn label(recording: &Recording, process: u32, object: ObjectId) -> String {
    recording.object(process, object).map_or_else(|| format!("#{}", object.0), |object| object.name.clone())
}

/// The order of events at one instant: a slice, then arrows.
const SLICE: u8 = 0;
const ARROW: u8 = 1;

fn callbacks(recording: &Recording, events: &mut Vec<(u64, u8, Value)>) {
    let published = publications(recording);
    let last_ns = recording.events.last().map_or(0, |timed| timed.event.time_ns);
    for (id, run) in runs(recording).into_iter().enumerate() {
        let (pid_, tid) = (recording.program(run.process).0, run.tid);
        let end_ns = run.end_ns.unwrap_or(last_ns);
        let mut arguments =
            json!({"release_to_start_us": micros(run.start_ns.saturating_sub(run.release_ns))});
        if let Some(message) = run.message {
            arguments["sequence_number"] = json!(message.sequence_number);
            if let Some(from) = published.get(&message) {
                arguments["publish_to_start_us"] = micros(run.start_ns.saturating_sub(from.time_ns));
                arrow(recording, id, from, (run.start_ns, pid_, tid), events);
            }
        }
        let slice = json!({
            "ph": "X", "cat": "callback", "name": label(recording, run.process, run.callback), "pid": pid_, "tid": tid,
            "dur": micros(end_ns.saturating_sub(run.start_ns)), "args": arguments,
        });
        events.push((run.start_ns, SLICE, slice));
    }
}

fn arrow(
    recording: &Recording,
    id: usize,
    from: &Publication,
    (start_ns, pid_, tid): (u64, u32, u32),
    events: &mut Vec<(u64, u8, Value)>,
) {
    let end = |ph: &str, pid: u32, tid: u32| json!({"ph": ph, "cat": "message", "name": "message", "id": id, "pid": pid, "tid": tid, "bp": "e"});
    events.push((from.time_ns, ARROW, end("s", recording.program(from.process).0, from.tid)));
    events.push((start_ns, ARROW, end("f", pid_, tid)));
}

/// Publications, takes, relays, and the sampler.
fn others(recording: &Recording, events: &mut Vec<(u64, u8, Value)>) {
    let mut following: HashMap<(u32, u32), u64> = HashMap::new();
    let mut spin: HashMap<(u32, u32), u64> = HashMap::new();
    // Backwards: a slice ends where the thread's next event is.
    for timed in recording.events.iter().rev() {
        let (process, tid, event) = (timed.process, timed.tid, timed.event);
        let (pid_, name, time_ns) =
            (recording.program(process).0, label(recording, process, event.object), event.time_ns);
        let slice = |name: &str, category: &str, duration_ns: u64| {
            let (ph, dur) = ("X", micros(duration_ns));
            json!({"ph": ph, "cat": category, "name": name, "pid": pid_, "tid": tid, "dur": dur})
        };
        let until = following.insert((process, tid), time_ns).unwrap_or(u64::MAX);
        match event.kind {
            EventKind::Publish => {
                let duration_ns = PUBLISH_NS.min(until.saturating_sub(time_ns) / 2);
                let mut slice = slice(&format!("publish {name}"), "publish", duration_ns);
                slice["args"] = json!({"sequence_number": key(event.arguments).sequence_number});
                events.push((time_ns, SLICE, slice));
            }
            EventKind::Take | EventKind::Receive | EventKind::Pass => {
                let arguments = json!({"sequence_number": key(event.arguments).sequence_number});
                let what = event.kind.name();
                let instant = json!({
                    "ph": "i", "s": "t", "cat": what, "name": format!("{what} {name}"), "pid": pid_, "tid": tid,
                    "args": arguments,
                });
                events.push((time_ns, SLICE, instant));
            }
            EventKind::SpinEnd => {
                spin.insert((process, tid), time_ns);
            }
            EventKind::SpinWake => {
                let end = spin.remove(&(process, tid)).unwrap_or(time_ns);
                events.push((time_ns, SLICE, slice("serve", "sampler", end.saturating_sub(time_ns))));
                spin.insert((process, tid), time_ns);
            }
            EventKind::SpinTimeout => {
                spin.insert((process, tid), time_ns);
            }
            EventKind::SpinStart => {
                if let Some(end) = spin.remove(&(process, tid)) {
                    events.push((time_ns, SLICE, slice("wait", "sampler", end.saturating_sub(time_ns))));
                }
            }
            EventKind::CallbackStart | EventKind::CallbackEnd => {}
        }
    }
}
