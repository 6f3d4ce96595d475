// SPDX-License-Identifier: MIT OR Apache-2.0
//! What does it cost a callback to read a parameter, and does a thread that sets parameters disturb it?
//!
//! The reads run in alternating rounds on one core, while nobody sets the parameter and while a thread on another core does
//! 10,000 times a second; beside them what r2r's programs do, which lock a map. Then a 1 kHz timer's callback reads parameters in
//! alternating rounds with and without that thread; its response times are compared.

use clap::Parser;
use futures::StreamExt;
use serde::Serialize;
use std::hint::black_box;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tautline::rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline::rt::permission::realtime_permitted;
use tautline::{
    CallbackOptions, Context, ContextBuilder, Node, ParameterReader, ParameterValue, Parameters, Realtime,
};
use tautline_benches::{Distribution, Disturbance, machine};
use tautline_rt::CoreSet;

const SETS_PER_SECOND: u64 = 10_000;
const PERIOD: Duration = Duration::from_millis(1);
/// Reads of each kind in one job of the callback.
const READS_PER_JOB: usize = 10;

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

#[derive(Serialize)]
struct Report {
    machine: String,
    disturbance: String,
    realtime: bool,
    reads: Vec<Read>,
    callback: Vec<Callback>,
    /// Of all jobs while parameters are set, to that of all jobs while they are not.
    p99_ratio: f64,
}

/// Nanoseconds per read, of each round.
#[derive(Serialize)]
struct Read {
    what: &'static str,
    being_set: bool,
    rounds: usize,
    min_ns: f64,
    p50_ns: f64,
    max_ns: f64,
}

/// Response times of the callback's jobs: from the release of the timer to the end of the job.
#[derive(Serialize)]
struct Callback {
    being_set: bool,
    jobs: u64,
    sets: u64,
    p50_us: f64,
    p99_us: f64,
    p999_us: f64,
    max_us: f64,
}

fn main() -> ExitCode {
    match measure(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("parameters: {error}");
            ExitCode::FAILURE
        }
    }
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
    let (rounds, reads, seconds) = if options.quick { (5, 100_000, 1) } else { (21, 1_000_000, 5) };
    // Before this program confines itself to cores.
    let (machine, disturbance) = (machine(), Disturbance::start());
    let cores: Vec<usize> = CoreSet::allowed()?.iter().collect();
    let (callback_core, setter_core) = (cores[cores.len() - 1], cores[0]);
    let realtime = realtime_permitted(ContextBuilder::SAMPLER_PRIORITY).is_ok();
    let mode = if realtime { Realtime::Required } else { Realtime::Off };
    let context = Context::builder().realtime(mode).sampler_core(callback_core).build()?;
    let mut node = Node::create(context.clone(), "parameters_bench", "")?;
    node.declare_parameter("gain", 1.5)?;
    node.declare_parameter("gains", vec![0.5; 16])?;
    node.declare_parameter("frame", "base_link".to_owned())?;

    let reads = read_costs(&node, rounds, reads, [callback_core, setter_core])?;
    let callback = disturbance_of_callback(
        &node,
        if options.quick { 2 } else { 6 },
        seconds,
        [callback_core, setter_core],
    )?;
    let p99_ratio = callback[1].p99_us / callback[0].p99_us;
    let report = Report { machine, disturbance: disturbance.report(), realtime, reads, callback, p99_ratio };
    print(&report);
    if let Some(path) = &options.json {
        std::fs::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    Ok(())
}

/// Sets the parameters, one after the other, until it is dropped.
struct Setter {
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<u64>>,
}

impl Setter {
    fn start(parameters: Parameters, core: usize) -> Setter {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || {
            // Where the measured thread does not run, if there is another core.
            let _ = tautline_rt::set_affinity(CoreSet::one(core));
            let (start_ns, mut sets) = (monotonic_ns(), 0);
            while !stopped.load(Ordering::Relaxed) {
                let value = sets as f64;
                let set = match sets % 3 {
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

const READS: [(&str, Work); 5] = [
    ("f64", |readers, _, _| {
        black_box(readers.gain.get());
    }),
    ("16 f64", |readers, _, _| {
        black_box(readers.gains.read().iter().sum::<f64>());
    }),
    ("string", |readers, _, _| {
        black_box(readers.frame.read().len());
    }),
    ("f64 by name, cloned from a locked map", |_, parameters, _| {
        black_box(parameters.get::<f64>("gain").ok());
    }),
    ("f64 as r2r's programs", |_, _, node| {
        let params = node.params.lock().expect("nobody panics");
        if let Some(ParameterValue::Double(gain)) = params.get("gain").map(|parameter| &parameter.value) {
            black_box(*gain);
        }
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
            let setter = being_set.then(|| Setter::start(parameters.clone(), setter_core));
            for (case, (_, work)) in READS.iter().enumerate() {
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
        for (case, (what, _)) in READS.into_iter().enumerate() {
            let of = times.iter().filter(|(set, of, _)| (*set, *of) == (being_set, case));
            let mut ns: Vec<f64> = of.map(|(.., ns)| *ns).collect();
            ns.sort_by(f64::total_cmp);
            let (min_ns, p50_ns, max_ns) = (ns[0], ns[ns.len() / 2], ns[ns.len() - 1]);
            reads.push(Read { what, being_set, rounds, min_ns, p50_ns, max_ns });
        }
    }
    Ok(reads)
}

fn disturbance_of_callback(
    node: &Node,
    rounds: usize,
    seconds: u64,
    [core, setter_core]: [usize; 2],
) -> Result<Vec<Callback>, Box<dyn std::error::Error>> {
    /// Which distribution the jobs of now belong to; none while the setter starts and stops.
    static BEING_SET: AtomicBool = AtomicBool::new(false);
    static RECORDED: AtomicBool = AtomicBool::new(false);
    let context = node.context().clone();
    let of_jobs = Arc::new(Mutex::new([Distribution::new(), Distribution::new()]));
    let timer = context_timer(&context)?;
    let mut readers = Readers::of(node)?;
    let recorded = of_jobs.clone();
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
            && let Ok(mut of_jobs) = recorded.try_lock()
        {
            of_jobs[usize::from(BEING_SET.load(Ordering::Relaxed))].record(response_ns);
        }
        async {}
    });
    let handle = node.spawn_callback(CallbackOptions::fifo(40).core(core).name("read"), work)?;
    let sampler = {
        let context = context.clone();
        std::thread::spawn(move || context.spin())
    };
    let mut sets = 0;
    let pause = Duration::from_millis(20);
    for _ in 0..rounds {
        for being_set in [false, true] {
            let setter = being_set.then(|| Setter::start(node.parameters().clone(), setter_core));
            BEING_SET.store(being_set, Ordering::Relaxed);
            std::thread::sleep(pause);
            RECORDED.store(true, Ordering::Release);
            std::thread::sleep(Duration::from_secs(seconds));
            RECORDED.store(false, Ordering::Release);
            std::thread::sleep(pause);
            sets += setter.map_or(0, Setter::stop);
        }
    }
    context.shutdown();
    sampler.join().map_err(|_| "the sampler panicked")??;
    handle.stop();
    handle.join()?;
    let of_jobs = of_jobs.lock().map_err(|_| "the callback panicked")?;
    let callback = |being_set: bool| {
        let jobs = &of_jobs[usize::from(being_set)];
        Callback {
            being_set,
            jobs: jobs.len(),
            sets: if being_set { sets } else { 0 },
            p50_us: jobs.quantile_us(0.5),
            p99_us: jobs.quantile_us(0.99),
            p999_us: jobs.quantile_us(0.999),
            max_us: jobs.max_us(),
        }
    };
    Ok(vec![callback(false), callback(true)])
}

fn context_timer(context: &Context) -> tautline::Result<tautline::Timer> {
    Node::create(context.clone(), "timer", "")?.create_wall_timer(PERIOD)
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
    println!("\nµs from release to end of a 1 kHz timer's job of {READS_PER_JOB} x 3 reads, {policy}\n");
    println!(
        "{:<9}  {:>7}  {:>9}  {:>7}  {:>7}  {:>7}  {:>7}",
        "being set", "jobs", "sets", "p50", "p99", "p99.9", "max"
    );
    for of in &report.callback {
        println!(
            "{:<9}  {:>7}  {:>9}  {:7.1}  {:7.1}  {:7.1}  {:7.1}",
            yes(of.being_set),
            of.jobs,
            of.sets,
            of.p50_us,
            of.p99_us,
            of.p999_us,
            of.max_us
        );
    }
    println!("\np99 while being set: {:.2} times that of the quiet rounds", report.p99_ratio);
    println!("\n{}\n{}", report.machine, report.disturbance);
}
