// SPDX-License-Identifier: MIT OR Apache-2.0
//! What does it cost a callback to read a parameter, and does a thread that sets parameters disturb it?
//!
//! The reads run in alternating rounds on one core, while nobody sets the parameter and while a thread on another core does
//! 10,000 times a second; beside them what r2r's programs do, which lock a map. Then a 1 kHz timer's callback reads parameters in
//! alternating rounds: while that thread is not there, while it only wakes as often and sets nothing, and while it sets. What counts
//! is the median, over the rounds, of the ratio of its 99th percentiles to that of the quiet part of the same round: a round that
//! others disturbed is one of many. What the thread that only wakes does to the callback is the machine's doing, not the setting's.

use clap::Parser;
use futures::StreamExt;
use serde::Serialize;
use std::hint::black_box;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tautline::rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline::{CallbackOptions, Node, ParameterReader, Parameters};
use tautline_benches::rows::extent;
use tautline_benches::{Distribution, Disturbance, Stage, Turns, machine, print_no_verdict, print_verdict};
use tautline_rt::CoreSet;
use tautline_rt::host::steal_ticks;

const SETS_PER_SECOND: u64 = 10_000;
const PERIOD: Duration = Duration::from_millis(1);
/// Reads of each kind in one job of the callback.
const READS_PER_JOB: usize = 10;
/// A read shall cost less, whoever sets.
const READ_LIMIT_NS: f64 = 100.0;
/// Setting shall make the callback's 99th percentile no greater than so many times the quiet one.
const P99_RATIO_LIMIT: f64 = 1.1;

/// Measures reading parameters beside a thread that sets them.
#[derive(Parser)]
struct Options {
    /// Fewer rounds: some seconds
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<std::path::PathBuf>,
}

struct Report {
    machine: String,
    disturbance: String,
    realtime: bool,
    /// The callback's core, and that of the thread that sets.
    cores: [usize; 2],
    reads: Vec<Read>,
    callback: Vec<Callback>,
}

/// Nanoseconds per read, of each round.
struct Read {
    what: &'static str,
    payload_bytes: usize,
    being_set: bool,
    rounds: usize,
    calls: u64,
    min_ns: f64,
    p50_ns: f64,
    max_ns: f64,
}

/// What the other thread does meanwhile.
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

/// Response times of the callback's jobs: from the release of the timer to the end of the job.
struct Callback {
    meanwhile: Meanwhile,
    jobs: Turns,
    missed: u64,
    sets: u64,
    steal_ticks: u64,
}

/// A line of the JSON, as other measurements have it.
#[derive(Serialize)]
struct Row {
    experiment: &'static str,
    system: &'static str,
    mode: String,
    payload_bytes: usize,
    n: u64,
    p50_us: f64,
    p99_us: Option<f64>,
    p999_us: Option<f64>,
    max_us: f64,
    lost: u64,
    /// Of the callback's 99th percentile to the quiet one: the median of the rounds, the least and the greatest.
    ratio: Option<[f64; 3]>,
    steal_ticks: Option<u64>,
    realtime: bool,
    disturbance: String,
}

impl Report {
    fn rows(&self) -> Vec<Row> {
        let reads = self.reads.iter().map(|read| Row {
            experiment: "read",
            system: if read.what.contains("r2r") { "r2r's way" } else { "tautline" },
            mode: format!("{}, {}", read.what, if read.being_set { "being set" } else { "not being set" }),
            payload_bytes: read.payload_bytes,
            n: read.rounds as u64 * read.calls,
            p50_us: read.p50_ns / 1e3,
            // Only each round as a whole is measured.
            p99_us: None,
            p999_us: None,
            max_us: read.max_ns / 1e3,
            lost: 0,
            ratio: None,
            steal_ticks: None,
            realtime: false,
            disturbance: self.disturbance.clone(),
        });
        let callback = self.callback.iter().map(|of| Row {
            experiment: "callback",
            system: "tautline",
            mode: of.meanwhile.name().to_owned(),
            payload_bytes: 0,
            n: of.jobs.of_all.len(),
            p50_us: of.jobs.of_all.quantile_us(0.5),
            p99_us: Some(of.jobs.of_all.quantile_us(0.99)),
            p999_us: Some(of.jobs.of_all.quantile_us(0.999)),
            max_us: of.jobs.of_all.max_us(),
            lost: of.missed,
            ratio: Some(of.jobs.ratio()),
            steal_ticks: Some(of.steal_ticks),
            realtime: self.realtime,
            disturbance: self.disturbance.clone(),
        });
        reads.chain(callback).collect()
    }

    /// What was asked for, and whether it is so.
    fn verdicts(&self) -> Vec<(bool, String)> {
        let slowest = self.reads.iter().filter(|read| read.is_of_reader());
        let slowest = slowest.map(|read| read.p50_ns).fold(0.0, f64::max);
        let sets = self.callback.iter().find(|of| of.meanwhile == Meanwhile::Sets);
        let ratio = sets.map_or(f64::NAN, |of| of.jobs.ratio()[0]);
        vec![
            (
                slowest < READ_LIMIT_NS,
                format!("a read costs {slowest:.0} ns at most (median of rounds), limit {READ_LIMIT_NS} ns"),
            ),
            (
                ratio <= P99_RATIO_LIMIT,
                format!(
                    "the callback's p99 beside {SETS_PER_SECOND} sets/s is {ratio:.2} times the quiet one (median of rounds), \
                     limit {P99_RATIO_LIMIT}"
                ),
            ),
        ]
    }
}

impl Read {
    /// Those through a `ParameterReader`, as a callback should.
    fn is_of_reader(&self) -> bool {
        READS[..3].iter().any(|(what, ..)| *what == self.what)
    }
}

fn main() -> ExitCode {
    tautline_benches::exit("parameters", measure(&Options::parse()))
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

fn measure(options: &Options) -> Result<(), Box<dyn std::error::Error>> {
    let (rounds, reads, parts, part) = match options.quick {
        true => (5, 100_000, 3, Duration::from_millis(500)),
        false => (21, 1_000_000, 15, Duration::from_secs(4)),
    };
    // Before this program confines itself to cores.
    let (machine, disturbance) = (machine(), Disturbance::start());
    let stage = Stage::new()?;
    let (cores, realtime) = ([stage.core, stage.other_core], stage.realtime);
    let mut node = Node::create(stage.context.clone(), "parameters_bench", "")?;
    node.declare_parameter("gain", 1.5)?;
    node.declare_parameter("gains", vec![0.5; 16])?;
    node.declare_parameter("frame", "base_link".to_owned())?;

    let reads = read_costs(&node, rounds, reads, cores)?;
    let callback = disturbance_of_callback(&stage, &node, parts, part)?;
    let report = Report { machine, disturbance: disturbance.report(), realtime, cores, reads, callback };
    print(&report);
    if let Some(path) = &options.json {
        tautline_benches::write_json(path, &report.rows())?;
    }
    if !stage.is_fit() {
        print_no_verdict();
        return Ok(());
    }
    for (holds, what) in report.verdicts() {
        print_verdict(holds, &what);
    }
    Ok(())
}

/// Sets the parameters, one after the other, until it is dropped.
struct Setter {
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<u64>>,
}

impl Setter {
    fn start(parameters: Parameters, core: usize, sets_any: bool) -> Setter {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || {
            // Where the measured thread does not run, if there is another core.
            let _ = tautline_rt::set_affinity(CoreSet::one(core));
            let (start_ns, mut sets) = (monotonic_ns(), 0);
            while !stopped.load(Ordering::Relaxed) {
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
        });
        Setter { stop, thread: Some(thread) }
    }

    fn stop(mut self) -> u64 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().map_or(0, |thread| thread.join().expect("the setter does not panic"))
    }
}

type Work = fn(&mut Readers, &Parameters, &Node);

/// What, its size, and the read. The first three are a callback's.
const READS: [(&str, usize, Work); 4] = [
    ("f64", 8, |readers, _, _| {
        black_box(readers.gain.get());
    }),
    ("16 f64", 128, |readers, _, _| {
        black_box(readers.gains.read().iter().sum::<f64>());
    }),
    ("string", 9, |readers, _, _| {
        black_box(readers.frame.read().len());
    }),
    ("f64 by name, cloned from a locked map", 8, |_, parameters, _| {
        black_box(parameters.get::<f64>("gain").ok());
    }),
];

fn read_costs(
    node: &Node,
    rounds: usize,
    calls: u64,
    [core, setter_core]: [usize; 2],
) -> Result<Vec<Read>, Box<dyn std::error::Error>> {
    let former = tautline_rt::current_affinity()?;
    tautline_rt::set_affinity(CoreSet::one(core))?;
    let (mut readers, parameters) = (Readers::of(node)?, node.parameters().clone());
    let mut times: Vec<(bool, usize, f64)> = Vec::new();
    for _ in 0..rounds {
        for being_set in [false, true] {
            let setter = being_set.then(|| Setter::start(parameters.clone(), setter_core, true));
            for (case, (.., work)) in READS.iter().enumerate() {
                let start = Instant::now();
                (0..calls).for_each(|_| work(&mut readers, &parameters, node));
                times.push((being_set, case, start.elapsed().as_nanos() as f64 / calls as f64));
            }
            setter.map(Setter::stop);
        }
    }
    tautline_rt::set_affinity(former)?;
    let mut reads = Vec::new();
    for being_set in [false, true] {
        for (case, (what, payload_bytes, _)) in READS.into_iter().enumerate() {
            let of = times.iter().filter(|(set, of, _)| (*set, *of) == (being_set, case));
            let [min_ns, p50_ns, max_ns] = extent(of.map(|(.., ns)| *ns).collect());
            reads.push(Read { what, payload_bytes, being_set, rounds, calls, min_ns, p50_ns, max_ns });
        }
    }
    Ok(reads)
}

/// What the callback's jobs of now are recorded to.
#[derive(Default)]
struct Recording {
    jobs: Distribution,
    missed: u64,
}

fn disturbance_of_callback(
    stage: &Stage,
    node: &Node,
    rounds: usize,
    part: Duration,
) -> Result<Vec<Callback>, Box<dyn std::error::Error>> {
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
            let setter = (meanwhile != Meanwhile::Nothing).then(|| {
                Setter::start(node.parameters().clone(), stage.other_core, meanwhile == Meanwhile::Sets)
            });
            std::thread::sleep(pause);
            let steal = steal_ticks(None);
            RECORDED.store(true, Ordering::Release);
            std::thread::sleep(part);
            RECORDED.store(false, Ordering::Release);
            let (missed, sets, ticks) = &mut counts[index];
            *ticks += steal_ticks(None).saturating_sub(steal);
            std::thread::sleep(pause);
            let wakes = setter.map_or(0, Setter::stop);
            *sets += if meanwhile == Meanwhile::Sets { wakes } else { 0 };
            let mut recording = recording.lock().map_err(|_| "the callback panicked")?;
            let Recording { jobs, missed: now } = std::mem::take(&mut *recording);
            *missed += now;
            Ok::<_, &str>(jobs)
        })
    })??;
    let of = |((meanwhile, jobs), (missed, sets, steal_ticks))| Callback {
        meanwhile,
        jobs,
        missed,
        sets,
        steal_ticks,
    };
    Ok(Meanwhile::ALL.into_iter().zip(turns).zip(counts).map(of).collect())
}

fn print(report: &Report) {
    let rounds = report.reads[0].rounds;
    println!("ns per read (least, median and greatest of {rounds} rounds)\n");
    println!("{:<38}  {:<9}  {:>7}  {:>7}  {:>7}", "what", "being set", "min", "p50", "max");
    let yes = |yes| if yes { "yes" } else { "no" };
    for read in &report.reads {
        let Read { what, being_set, min_ns, p50_ns, max_ns, .. } = read;
        println!("{what:<38}  {:<9}  {min_ns:7.1}  {p50_ns:7.1}  {max_ns:7.1}", yes(*being_set));
    }
    let policy = if report.realtime { "SCHED_FIFO" } else { "no real-time priority" };
    let [core, setter_core] = report.cores;
    println!(
        "\nµs from release to end of a 1 kHz timer's job of {READS_PER_JOB} x 3 reads, {policy} on core {core}, the other thread \
         on core {setter_core}\n"
    );
    println!(
        "{:<15}  {:>7}  {:>7}  {:>6}  {:>7}  {:>7}  {:>7}  {:>7}  {:>6}  p99 to the quiet one's",
        "meanwhile", "jobs", "sets", "missed", "p50", "p99", "p99.9", "max", "steal"
    );
    for of in &report.callback {
        let ([ratio, least, greatest], jobs) = (of.jobs.ratio(), &of.jobs.of_all);
        println!(
            "{:<15}  {:>7}  {:>7}  {:>6}  {:7.1}  {:7.1}  {:7.1}  {:7.1}  {:>6}  {ratio:.2} ({least:.2} to {greatest:.2})",
            of.meanwhile.name(),
            jobs.len(),
            of.sets,
            of.missed,
            jobs.quantile_us(0.5),
            jobs.quantile_us(0.99),
            jobs.quantile_us(0.999),
            jobs.max_us(),
            of.steal_ticks,
        );
    }
    println!("\n{}\n{}\n", report.machine, report.disturbance);
}
