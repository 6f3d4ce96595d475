// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages at a rate, from one process to others: what publishing costs, how late they come, what it takes of the processor.
//!
//! With real-time priorities the sender has a core, and all receivers another one.

use crate::job::Job as Task;
use crate::process::{self, Process};
use crate::{Bench, Experiment, Result};
use std::time::{Duration, Instant};
use tautline_benches::systems::iceoryx;
use tautline_benches::systems::tautline::{self, Frame8MiB, Frame64B, Frame64KiB};
use tautline_exchange::{Exchange, Job, Line, Role, Way, to_the_last};
use tautline_harness::Distribution;
use tautline_harness::readings::{Column, Reading};
use tautline_rt::{CoreSet, set_affinity};

/// How long a process may take to set itself up.
const PATIENCE: Duration = Duration::from_secs(60);
/// How long what is under way may take to arrive.
const DRAIN: Duration = Duration::from_millis(500);
const SMALL_BYTES: usize = size_of::<Frame64B>();
const CLOUD_BYTES: usize = size_of::<Frame64KiB>();
const IMAGE_BYTES: usize = size_of::<Frame8MiB>();
const MIB: f64 = 1048576.0;

/// A way of a system in which one thread receives all messages of a process.
struct System {
    /// In the report.
    title: &'static str,
    name: &'static str,
    mode: &'static str,
}

/// The sampler wakes the thread.
const TAUTLINE: System = System { title: "tautline", name: "tautline", mode: "one-thread-blocking-default" };
/// The publisher wakes it.
const DIRECT: System = System { title: "tautline, direct", name: "tautline", mode: "one-thread-default" };
const ICEORYX: System = System { title: "iceoryx2", name: "iceoryx2", mode: "waitset" };

#[derive(Clone, Copy)]
struct Flow {
    system: &'static System,
    payload_bytes: usize,
    topics: usize,
    /// Of each topic.
    rate_hz: f64,
    processes: usize,
    /// Of each topic in each receiving process.
    subscribers: usize,
}

const SMALL: Flow = Flow {
    system: &TAUTLINE,
    payload_bytes: SMALL_BYTES,
    topics: 1,
    rate_hz: 100.0,
    processes: 1,
    subscribers: 1,
};

/// 200 topics with two subscriptions each, in two processes.
pub fn load(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let mut rows = Vec::new();
    for system in [&TAUTLINE, &DIRECT, &ICEORYX] {
        let flow = Flow { system, topics: 200, processes: 2, ..SMALL };
        rows.extend(bench.flow(Experiment::Load, flow.topics, flow)?);
    }
    Ok(rows)
}

/// Images that nobody copies.
pub fn images(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let sizes: &[usize] = if bench.quick { &[1, 8, 32] } else { &[1, 2, 4, 8, 16, 32] };
    let mut rows = Vec::new();
    for &size in sizes {
        let processes = size.min(4);
        let image = Flow { payload_bytes: IMAGE_BYTES, rate_hz: 30.0, ..SMALL };
        let flow = Flow { processes, subscribers: size / processes, ..image };
        rows.extend(bench.flow(Experiment::Images, size, flow)?);
    }
    Ok(rows)
}

pub fn fan_out(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let sizes: &[usize] = if bench.quick { &[10, 50] } else { &[10, 20, 50, 100, 200] };
    let mut rows = Vec::new();
    for &size in sizes {
        let flow = Flow { processes: 10, subscribers: size / 10, ..SMALL };
        rows.extend(bench.flow(Experiment::FanOut, size, flow)?);
    }
    Ok(rows)
}

/// One subscription per process, the send call beside iceoryx2's.
pub fn readers(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let sizes: &[usize] = if bench.quick { &[10, 100] } else { &[10, 100, 200] };
    let mut rows = Vec::new();
    for &size in sizes {
        let flow = |system| bench.flow(Experiment::Readers, size, Flow { system, processes: size, ..SMALL });
        rows.extend(beside_iceoryx(flow, PUBLISHING, [(Column::P50, TO_EACH), (Column::P99, UNKNOWN)])?);
    }
    Ok(rows)
}

/// Large payloads of which nobody copies, as many at once as an autonomous car has: the time until they are read beside iceoryx2's.
///
/// Most of Tautline's memory is spare samples (`Limits::spare_bytes`): a publisher has four times a core's second-level cache, here 63
/// samples of 64 KiB with one of 1 MiB, where depth (10), two subscriptions (4 each) and loans (4) need 22. With 200 publishers that is 790
/// instead of 275 MiB; iceoryx2 has no spare ones.
pub fn clouds(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let clouds = Flow { payload_bytes: CLOUD_BYTES, topics: 200, processes: 2, ..SMALL };
    let flow = |system| bench.flow(Experiment::Clouds, clouds.topics, Flow { system, ..clouds });
    beside_iceoryx(flow, OF_ONE, [(Column::P50, TWO_WAKES), (Column::P999, UNKNOWN)])
}

/// Payloads of which nobody copies take as long as the smallest one, whatever their size.
pub fn sizes(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let larger: &[usize] = if bench.quick { &[IMAGE_BYTES] } else { &[CLOUD_BYTES, IMAGE_BYTES] };
    let flow = |system, payload_bytes| {
        bench.flow(Experiment::Sizes, payload_bytes, Flow { system, payload_bytes, ..SMALL })
    };
    let latency = |rows: &[Reading]| rows.iter().find(|row| row.what == OF_ONE).map(|row| row.p50);
    let mut rows = flow(&TAUTLINE, SMALL_BYTES)?;
    let smallest = latency(&rows);
    for &payload_bytes in larger {
        let of_it = flow(&TAUTLINE, payload_bytes)?;
        if let Some((p50, smallest)) = latency(&of_it).zip(smallest) {
            let row = Reading::of(Experiment::Sizes, payload_bytes, "median latency", "x that of 64 B");
            rows.push(row.value(p50 / smallest).at_most(FLAT));
        }
        rows.extend(of_it);
    }
    for &payload_bytes in [SMALL_BYTES].iter().chain(larger) {
        rows.extend(flow(&ICEORYX, payload_bytes)?);
    }
    Ok(rows)
}

/// The goal for a larger payload's latency, in that of the smallest.
const FLAT: f64 = 1.1;
const PUBLISHING: &str = "publishing: loan, write a stamp, publish, wake";
const OF_ONE: &str = "from before the loan until a subscription has read it";
// Causes, if it takes longer.
const TO_EACH: &str = "each sleeping process takes a futex wake, of either system";
const TWO_WAKES: &str = "the sampler is woken first, and wakes the callback's thread";
const UNKNOWN: &str = "no cause is known";

/// Tautline's rows, of which those that say `what` shall be no more than iceoryx2's in these columns, or for this cause; and iceoryx2's.
fn beside_iceoryx(
    flow: impl Fn(&'static System) -> Result<Vec<Reading>>,
    what: &str,
    columns: [(Column, &str); 2],
) -> Result<Vec<Reading>> {
    let (ours, theirs) = (flow(&TAUTLINE)?, flow(&ICEORYX)?);
    let is_it = |row: &&Reading| row.what == what;
    let goals = columns.into_iter().filter_map(|(column, cause)| {
        let (own, rival) = (ours.iter().find(is_it)?, theirs.iter().find(is_it)?);
        let (number, limit) = (own.column(column)?, rival.column(column)?);
        let size = own.size as usize;
        let row =
            Reading::of(own.experiment.clone(), size, format!("{what}, {}", column.name()), "x iceoryx2's");
        Some(row.value(number / limit).at_most(1.0).note(if number > limit { cause } else { "" }))
    });
    let goals: Vec<_> = goals.collect();
    Ok([goals, ours, theirs].concat())
}

impl<'a> Bench<'a> {
    fn flow(&self, experiment: Experiment, size: usize, flow: Flow) -> Result<Vec<Reading>> {
        let budget = Duration::from_secs(if self.quick { 1 } else { 10 });
        let mut fars: Vec<Process<'a, Line>> = Vec::new();
        for _ in 0..flow.processes {
            let mut far = self.start(&self.task(flow, Role::Far, budget)?)?;
            far.expect(PATIENCE, Line::ready)?;
            fars.push(far);
        }
        let mut near: Process<'a, Line> = self.start(&self.task(flow, Role::Near, budget)?)?;
        for far in &mut fars {
            far.expect(PATIENCE, |line| matches!(line, Line::Connected { .. }).then_some(()))?;
        }
        let pids = fars.iter().map(Process::id).chain([near.id()]);
        let pss: u64 = pids.map(|pid| process::memory(pid).pss).sum();
        near.tell("go")?;
        let sent = near.expect(PATIENCE + budget * 3, Line::measured)?;
        let since = Instant::now();
        for far in &mut fars {
            // Whether the last one has come: what has not is counted as lost.
            let is_last = |line| matches!(line, Line::Complete).then_some(());
            let _ = far.wait_for(DRAIN.saturating_sub(since.elapsed()), is_last)?;
        }
        // Of one topic: until the last subscription had it.
        let (mut publishing, mut latency) = (Distribution::new(), Distribution::new());
        sent.times_ns.iter().for_each(|&time_ns| publishing.record(time_ns));
        let (mut cpu_ns, mut lost, mut arrivals) = (sent.cpu_ns, 0, Vec::new());
        for far in &mut fars {
            far.tell("stop")?;
            let received = far.expect(PATIENCE, Line::measured)?;
            far.finish()?;
            cpu_ns += received.cpu_ns;
            lost += received.lost;
            match flow.topics {
                1 => arrivals.extend(received.numbers.into_iter().zip(received.times_ns)),
                _ => received.times_ns.iter().for_each(|&time_ns| latency.record(time_ns)),
            }
        }
        near.finish()?;
        to_the_last(arrivals, flow.processes).iter().for_each(|(_, time_ns)| latency.record(*time_ns));
        if latency.is_empty() {
            return Err(format!("no message arrived everywhere; {lost} were lost").into());
        }
        let row = |what: &str, unit| Reading::of(experiment, size, what, unit).system(flow.system.title);
        let of_latency = match experiment {
            Experiment::Load | Experiment::Clouds | Experiment::Sizes => OF_ONE,
            _ => "from before the loan until the last subscription has read it",
        };
        let cpu_percent = 100.0 * cpu_ns as f64 / 1e9 / sent.seconds;
        Ok(vec![
            row(PUBLISHING, "µs").times(&publishing),
            row(of_latency, "µs").times(&latency),
            row("CPU of all processes", "% of a core").value(cpu_percent),
            row("memory of all processes (PSS)", "MiB").value(pss as f64 / MIB),
            row("messages lost", "messages").value(lost as f64).at_most(0.0),
            row("messages that were due before the one before was sent", "messages").value(sent.late as f64),
        ])
    }

    fn task(&self, flow: Flow, role: Role, budget: Duration) -> Result<Task> {
        let cores: Vec<usize> = CoreSet::allowed()?.iter().collect();
        let core = match (self.realtime, &cores[..], role) {
            (true, [near, ..], Role::Near) => Some(*near),
            (true, [.., far], Role::Far) => Some(*far),
            _ => None,
        };
        let job = Job {
            role,
            exchange: Exchange::Paced { rate: flow.rate_hz * flow.topics as f64 },
            payload_bytes: flow.payload_bytes,
            budget,
            core,
            realtime: self.realtime,
            domain: crate::job::DOMAIN,
            topic: "/flow".to_owned(),
            endpoint: Some(self.scratch.directory().to_string_lossy().into_owned()),
            way: Way {
                mode: flow.system.mode.to_owned(),
                topics: flow.topics,
                subscribers: flow.subscribers,
                processes: flow.processes,
                times_sending: true,
                ..Way::default()
            },
        };
        Ok(Task::Flow { system: flow.system.name.to_owned(), job })
    }
}

/// Runs one process. No other systems, sizes or exchanges are in this program: what memory processes take is measured, too.
pub fn run(system: &str, job: &Job) -> Result<()> {
    if let Some(core) = job.core {
        set_affinity(CoreSet::one(core))?;
    }
    match (system, job.payload_bytes) {
        ("iceoryx2", _) => iceoryx::flow(job),
        (_, SMALL_BYTES) => tautline::flow::<Frame64B>(job),
        (_, CLOUD_BYTES) => tautline::flow::<Frame64KiB>(job),
        _ => tautline::flow::<Frame8MiB>(job),
    }
}
