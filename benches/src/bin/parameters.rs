// SPDX-License-Identifier: MIT OR Apache-2.0
//! What does it cost a callback to read a parameter, and does a thread that sets parameters disturb it?
//!
//! The reads run in alternating rounds on one core, while nobody sets the parameter and while a thread on another core does
//! 10,000 times a second; beside them what r2r's programs do, which lock a map. Then a 1 kHz timer's callback reads parameters in
//! alternating rounds: while that thread is not there, while it only wakes as often and sets nothing, and while it sets. What counts
//! is the median, over the rounds, of the ratio of its 99th percentiles to that of the quiet part of the same round: a round that
//! others disturbed is one of many. What the thread that only wakes does to the callback is the machine's doing, not the setting's.

use futures::StreamExt;
use std::hint::black_box;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tautline::{CallbackOptions, Node, ParameterReader, Parameters};
use tautline_benches::Stage;
use tautline_harness::claims::{Claim, Goal, Ways, judge};
use tautline_harness::rows::{Metric, Row, extent};
use tautline_harness::table::Column::{Number, Words};
use tautline_harness::table::{Table, figure, markdown, of_rows};
use tautline_harness::verdict::{self, Verdict};
use tautline_harness::{
    Beside, Distribution, Disturbance, Documented, Result, TurnRow, Turns, cells, machine, program,
};
use tautline_rt::CoreSet;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_rt::host::steal_ticks;

const SETS_PER_SECOND: u64 = 10_000;
const PERIOD: Duration = Duration::from_millis(1);
/// Reads of each kind in one job of the callback.
const READS_PER_JOB: usize = 10;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Meanwhile {
    Nothing,
    Wakes,
    Sets,
}

impl Meanwhile {
    const ALL: [Meanwhile; 3] = [Meanwhile::Nothing, Meanwhile::Wakes, Meanwhile::Sets];

    fn name(self) -> &'static str {
        match self {
            Meanwhile::Nothing => "quiet",
            Meanwhile::Wakes => "a thread wakes",
            Meanwhile::Sets => "a thread sets",
        }
    }
}

fn main() -> ExitCode {
    program("parameters", "Measures reading parameters beside a thread that sets them", measure)
}

struct Readers {
    gain: ParameterReader<f64>,
    gains: ParameterReader<Vec<f64>>,
    frame: ParameterReader<String>,
}

impl Readers {
    fn of(node: &Node) -> tautline::Result<Readers> {
        Ok(Readers {
            gain: node.parameter("gain")?,
            gains: node.parameter("gains")?,
            frame: node.parameter("frame")?,
        })
    }
}

fn measure(options: &Documented) -> Result {
    let (rounds, reads, parts, part) = match options.run.quick {
        true => (5, 100_000, 3, Duration::from_millis(500)),
        false => (21, 1_000_000, 15, Duration::from_secs(4)),
    };
    let (machine, disturbance) = (machine(), Disturbance::start());
    let stage = Stage::new()?;
    let mut node = Node::create(stage.context.clone(), "parameters_bench", "")?;
    node.declare_parameter("gain", 1.5)?;
    node.declare_parameter("gains", vec![0.5; 16])?;
    node.declare_parameter("frame", "base_link".to_owned())?;

    let mut rows = read_costs(&stage, &node, rounds, reads)?;
    let callback = disturbance_of_callback(&stage, &node, parts, part)?;
    let policy = if stage.realtime { "SCHED_FIFO" } else { "no real-time priority" };
    let (core, other_core) = (stage.core, stage.other_core);
    println!(
        "\nµs from release to end of a 1 kHz timer's job of {READS_PER_JOB} x 3 reads, {policy} on core {core}, the other thread \
         on core {other_core}\n{}",
        of_rows(callback.iter().map(|row| &row.row))
    );
    let disturbance = disturbance.report();
    println!("\n{machine}\n{disturbance}\n");
    rows.extend(callback);
    for row in &mut rows {
        (row.disturbance, row.row.unfit) = (disturbance.clone(), stage.unfit());
    }
    options.write(&rows, || document(&rows, &machine, &disturbance))?;
    verdict::print(&verdicts(&rows.into_iter().map(|row| row.row).collect::<Vec<_>>()))
}

/// A read while a thread sets it takes at most 0.1 µs; a callback is not disturbed by 10,000 sets a second.
fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let modes = READS.map(|(what, ..)| format!("{what}, {}", WHEN[1]));
    let modes = modes.each_ref().map(|mode| [mode.as_str()]);
    let reads = modes.iter().zip(READS).filter(|(_, (_, system, ..))| *system == "tautline");
    let reads = reads.map(|(mode, (_, system, ..))| {
        Claim::new(Metric::P50, Ways::new("read", None, system, mode), Goal::Number(0.1))
    });
    let [quiet, _, set] = Meanwhile::ALL.map(|meanwhile| [meanwhile.name()]);
    let [quiet, set] = [&quiet, &set].map(|mode| Ways::new("callback", None, "tautline", mode));
    let late = Claim { however_few: true, ..Claim::new(Metric::P99, set, Goal::Times(1.1, quiet)) };
    let missed = Claim::new(Metric::Lost, set, Goal::Number(0.0));
    judge(rows, reads.chain([late, missed]))
}

/// Sets the parameters, one after the other, or only wakes as often; returns how often.
fn set_beside(parameters: Parameters, core: usize, sets_any: bool) -> Beside<u64> {
    Beside::start(move |stop| {
        // Where the measured thread does not run, if there is another core.
        let _ = tautline_rt::set_affinity(CoreSet::one(core));
        let (start_ns, mut sets) = (monotonic_ns(), 0);
        while !stop.load(Ordering::Relaxed) {
            let value = sets as f64;
            let set = match sets % 3 {
                _ if !sets_any => Ok(()),
                0 => parameters.set("gain", value),
                1 => parameters.set("gains", vec![value; 16]),
                _ => parameters.set("frame", format!("frame {sets}")),
            };
            set.expect("any such value may be set");
            sets += 1;
            sleep_until_monotonic(start_ns + sets * (1_000_000_000 / SETS_PER_SECOND));
        }
        sets
    })
}

type Work = fn(&mut Readers, &Parameters);

/// What, whose way, its size, and the read.
const READS: [(&str, &str, usize, Work); 4] = [
    ("f64", "tautline", 8, |readers, _| {
        black_box(readers.gain.get());
    }),
    ("16 f64", "tautline", 128, |readers, _| {
        black_box(readers.gains.read().iter().sum::<f64>());
    }),
    ("string", "tautline", 9, |readers, _| {
        black_box(readers.frame.read().len());
    }),
    ("f64 by name, cloned from a locked map", "r2r's way", 8, |_, parameters| {
        black_box(parameters.get::<f64>("gain").ok());
    }),
];

/// When they are measured.
const WHEN: [&str; 2] = ["not being set", "being set"];

/// Measures the reads and prints what they cost.
fn read_costs(stage: &Stage, node: &Node, rounds: usize, calls: u64) -> Result<Vec<TurnRow>> {
    let former = tautline_rt::current_affinity()?;
    tautline_rt::set_affinity(CoreSet::one(stage.core))?;
    let (mut readers, parameters) = (Readers::of(node)?, node.parameters().clone());
    // µs per read of each round; first those while nobody sets.
    let mut times_us: [[Vec<f64>; READS.len()]; 2] = Default::default();
    for _ in 0..rounds {
        for (is_set, times_us) in [false, true].into_iter().zip(&mut times_us) {
            let setter = is_set.then(|| set_beside(parameters.clone(), stage.other_core, true));
            for (times_us, (.., work)) in times_us.iter_mut().zip(READS) {
                let start = Instant::now();
                (0..calls).for_each(|_| work(&mut readers, &parameters));
                times_us.push(start.elapsed().as_secs_f64() * 1e6 / calls as f64);
            }
            setter.map(Beside::end);
        }
    }
    tautline_rt::set_affinity(former)?;
    println!("ns per read (least, median and greatest of {rounds} rounds)\n");
    let mut table = Table::new(0, [Words("read"), Number("min"), Number("p50"), Number("max")]);
    let mut rows = Vec::new();
    for (when, times_us) in WHEN.into_iter().zip(times_us) {
        for ((what, system, payload_bytes, _), times_us) in READS.into_iter().zip(times_us) {
            let extent_us = extent(times_us);
            let (mode, n) = (format!("{what}, {when}"), rounds as u64 * calls);
            let [min, p50, max] = extent_us.map(|us| format!("{:.1}", us * 1e3));
            table.add(cells![&mode, min, p50, max]);
            // Only each round as a whole is measured.
            let [_, p50_us, max_us] = extent_us.map(Some);
            let (experiment, system) = ("read".to_owned(), system.to_owned());
            let row = Row { experiment, system, mode, payload_bytes, n, p50_us, max_us, ..Row::default() };
            rows.push(TurnRow { row, ..TurnRow::default() });
        }
    }
    println!("{table}");
    Ok(rows)
}

/// What a read costs, and what a thread that sets does to a callback.
fn document(rows: &[TurnRow], machine: &str, disturbance: &str) -> String {
    let ns = |mode: &str| {
        let row = rows.iter().find(|row| row.row.mode == mode);
        row.and_then(|row| row.row.p50_us).map_or("-".to_owned(), |us| format!("{:.1}", us * 1e3))
    };
    let read = |(what, ..): &(&str, &str, usize, Work)| {
        vec![(*what).to_owned(), ns(&format!("{what}, {}", WHEN[0])), ns(&format!("{what}, {}", WHEN[1]))]
    };
    let callback = |TurnRow { row, ratio, .. }: &TurnRow| {
        let times = [row.p50_us, row.p99_us, row.p999_us, row.max_us].map(figure);
        let [median, least, greatest] = ratio.unwrap_or([f64::NAN; 3]);
        let ratio = format!("{median:.2} ({least:.2} to {greatest:.2})");
        [vec![row.mode.clone()], times.to_vec(), vec![ratio]].concat()
    };
    let of_callback: Vec<&TurnRow> = rows.iter().filter(|row| row.row.experiment == "callback").collect();
    let jobs: u64 = of_callback.iter().map(|row| row.row.n).sum();
    let titles =
        ["1 kHz callback, meanwhile", "p50 µs", "p99 µs", "p99.9 µs", "max µs", "p99 to the quiet one's"];
    format!(
        "{}\n{}\n`cargo xtask bench parameters`: medians of rounds; {jobs} jobs in alternating rounds, the callback FIFO 40 on one \
         core, the other thread, {SETS_PER_SECOND} times a second, on another; {disturbance}; {machine}.\n",
        markdown(["read", "ns", "ns, while it is set"], 1, READS.iter().map(read)),
        markdown(titles, 1, of_callback.into_iter().map(callback))
    )
}

/// What the callback's jobs of now are recorded to.
#[derive(Default)]
struct Recording {
    jobs: Distribution,
    missed: u64,
}

fn disturbance_of_callback(stage: &Stage, node: &Node, rounds: u32, part: Duration) -> Result<Vec<TurnRow>> {
    static RECORDED: AtomicBool = AtomicBool::new(false);
    let recording = Arc::new(Mutex::new(Recording::default()));
    // What a node has made ends with it.
    let mut timers = Node::create(stage.context.clone(), "timer", "")?;
    let timer = timers.create_wall_timer(PERIOD)?;
    let mut readers = Readers::of(node)?;
    let recorded = recording.clone();
    let work = timer.for_each(move |tick| {
        let mut sum = 0.0;
        for _ in 0..READS_PER_JOB {
            sum += readers.gain.get() + readers.gains.read().iter().sum::<f64>();
            sum += readers.frame.read().len() as f64;
        }
        black_box(sum);
        let response_ns = monotonic_ns().saturating_sub(tick.release_ns);
        // Never taken by another thread while jobs are recorded.
        if RECORDED.load(Ordering::Acquire)
            && let Ok(mut recorded) = recorded.try_lock()
        {
            recorded.jobs.record(response_ns);
            recorded.missed += tick.missed;
        }
        async {}
    });
    let callback = node.spawn_callback(CallbackOptions::fifo(40).core(stage.core).name("read"), work)?;
    let pause = Duration::from_millis(20);
    let mut counts = [(0, 0, 0); Meanwhile::ALL.len()];
    let turns: [Turns; Meanwhile::ALL.len()] = stage.spin_while(vec![callback], || {
        Turns::take(rounds, |index| {
            let meanwhile = Meanwhile::ALL[index];
            let sets_any = meanwhile == Meanwhile::Sets;
            let setter = (meanwhile != Meanwhile::Nothing)
                .then(|| set_beside(node.parameters().clone(), stage.other_core, sets_any));
            std::thread::sleep(pause);
            let steal = steal_ticks(None);
            RECORDED.store(true, Ordering::Release);
            std::thread::sleep(part);
            RECORDED.store(false, Ordering::Release);
            let (missed, sets, ticks) = &mut counts[index];
            *ticks += steal_ticks(None).saturating_sub(steal);
            std::thread::sleep(pause);
            let wakes = setter.map_or(0, Beside::end);
            *sets += if sets_any { wakes } else { 0 };
            let mut recording = recording.lock().map_err(|_| "the callback panicked")?;
            let Recording { jobs, missed: now } = std::mem::take(&mut *recording);
            *missed += now;
            Ok::<_, &str>(jobs)
        })
    })??;
    let of = |((meanwhile, turns), (missed, sets, steal)): ((Meanwhile, Turns), (u64, u64, u64))| {
        let mut of = turns.row("callback", "tautline", meanwhile.name(), "quiet one");
        of.row.lost = missed;
        of.row.note += &format!("; {sets} sets, steal {steal} ticks");
        (of.steal_ticks, of.realtime) = (Some(steal), stage.realtime);
        of
    };
    Ok(Meanwhile::ALL.into_iter().zip(turns).zip(counts).map(of).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documents_tables_have_reads_and_the_callback() {
        let row = |experiment: &str, mode: &str, us: f64, ratio| {
            let (experiment, mode) = (experiment.to_owned(), mode.to_owned());
            let (p50_us, p99_us) = (Some(us), Some(2.0 * us));
            TurnRow {
                row: Row { experiment, mode, p50_us, p99_us, n: 10, ..Row::default() },
                ratio,
                ..TurnRow::default()
            }
        };
        let rows = [
            row("read", "f64, not being set", 0.0031, None),
            row("read", "f64, being set", 0.0052, None),
            row("callback", "quiet", 10.0, Some([1.0; 3])),
            row("callback", "a thread sets", 10.5, Some([1.05, 0.97, 1.2])),
        ];
        let tables = document(&rows, "a machine", "steal 3 ticks");
        for line in [
            "| f64 | 3.1 | 5.2 |\n",
            "| quiet | 10.00 | 20.00 | - | - | 1.00 (1.00 to 1.00) |\n",
            "| a thread sets | 10.50 | 21.00 | - | - | 1.05 (0.97 to 1.20) |\n",
            "20 jobs in alternating rounds",
            "steal 3 ticks; a machine",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }
}
