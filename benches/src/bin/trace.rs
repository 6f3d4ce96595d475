// SPDX-License-Identifier: MIT OR Apache-2.0
//! What does a trace event cost where it happens: while nobody records, while a recorder is there?
//!
//! The cases run in alternating rounds on one core; a loop without an event is measured beside them. Built with
//! `--features lttng`, every event is a tracepoint as well: run it inside and outside of an LTTng session.

use std::hint::black_box;
use std::process::ExitCode;
use std::time::Instant;
use tautline_harness::readings::{Reading, shown, table};
use tautline_harness::rows::extent;
use tautline_harness::{Disturbance, Result, Run, machine, program};
use tautline_rt::clock::monotonic_ns;
use tautline_trace::{MessageId, ObjectId, Recorder, TraceMode};

/// None of ROS 2's: no topic is opened.
const DOMAIN: u32 = 1300;

type Work = fn(ObjectId, u64);

const CASES: [(&str, Work); 4] = [
    ("loop without an event", |object, n| {
        black_box((object, n));
    }),
    ("callback_start", |object, n| tautline_trace::callback_start(black_box(object), n)),
    ("publish", |object, n| {
        let message = MessageId { sequence_number: n, source_timestamp_ns: 1, gid: [2, 3], address: 4 };
        tautline_trace::publish(black_box(object), &message);
    }),
    ("reading the clock", |_, _| {
        black_box(monotonic_ns());
    }),
];

fn main() -> ExitCode {
    program("trace", "Measures what a trace event costs", measure)
}

fn measure(options: &Run) -> Result {
    let (rounds, calls) = if options.quick { (5, 200_000) } else { (21, 5_000_000) };
    let (machine, disturbance) = (machine(), Disturbance::start());
    if let Some(core) = tautline_rt::CoreSet::allowed()?.iter().last() {
        tautline_rt::set_affinity(tautline_rt::CoreSet::one(core))?;
    }
    tautline_trace::configure(TraceMode::Ready.into());
    let _membership = tautline_trace::join(DOMAIN)?;
    let object = tautline_trace::publisher_init("/bench", 1, [2, 3]);
    let mut times: Vec<(bool, usize, f64)> = Vec::new();
    for _ in 0..rounds {
        for recording in [false, true] {
            let recorder = if recording { Some(Recorder::start(DOMAIN)?) } else { None };
            tautline_trace::attend();
            for (case, (_, work)) in CASES.iter().enumerate() {
                let start = Instant::now();
                (0..calls).for_each(|n| work(object.id(), n));
                times.push((recording, case, start.elapsed().as_nanos() as f64 / calls as f64));
            }
            drop(recorder);
            tautline_trace::attend();
        }
    }
    let mut readings = Vec::new();
    for (recording, experiment) in [(false, "nobody records"), (true, "a recorder")] {
        for (case, (name, _)) in CASES.into_iter().enumerate() {
            let of = times.iter().filter(|(on, of, _)| (*on, *of) == (recording, case));
            let [min_ns, p50_ns, max_ns] = extent(of.map(|(.., ns)| *ns).collect());
            let reading =
                Reading::of(experiment, 0, name, "ns").value(p50_ns).note(format!("least {}", shown(min_ns)));
            readings.push(Reading { n: rounds, max: Some(max_ns), ..reading });
        }
    }
    let lttng = if cfg!(feature = "lttng") { "; each event is an LTTng tracepoint, too" } else { "" };
    println!("ns per call, of {rounds} rounds of {calls} calls{lttng}");
    for experiment in readings.chunk_by(|a, b| a.experiment == b.experiment) {
        println!("\n{}\n{}", experiment[0].experiment, table(experiment));
    }
    println!("\n{machine}\n{}", disturbance.report());
    options.write(&readings)
}
