// SPDX-License-Identifier: MIT OR Apache-2.0
//! Round trips of `rmw_wait` and take between two processes, on rmw_tautline and on Fast DDS's RMW: the same program calls both by the
//! names that rcl uses.

#[path = "../src/bindings.rs"]
mod bindings;
mod rmw;

use clap::Parser;
use serde_json::{Value, json};
use std::fmt;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tautline_exchange::{Exchange, Job, Line, Link, Measured, Result, Role, Way, drive, say, stop_flag};
use tautline_rt::{IdleHold, host};

/// Half round trips of rmw_wait and take, in two processes
#[derive(Parser)]
#[command(after_help = "Examples:
  cargo xtask bench rmw
  cargo xtask bench rmw --quick --json rmw.json")]
struct Arguments {
    /// Fewer and shorter rounds: half a minute
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// These lengths of messages only
    #[arg(long, value_name = "N,...", value_delimiter = ',', value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(48..1 << 30))]
    bytes: Vec<usize>,
    /// Without real-time priorities, where they are not permitted
    #[arg(long)]
    no_rt: bool,
    /// rmw_tautline's library
    #[arg(long, value_name = "LIBRARY")]
    tautline: PathBuf,
    /// Fast DDS's RMW
    #[arg(long, value_name = "LIBRARY", default_value = "librmw_fastrtps_cpp.so")]
    fast_dds: PathBuf,
    /// One end of a round trip, for this program's own use
    #[arg(long, hide = true)]
    end: Option<String>,
}

/// Nobody else measures or tests there.
const DOMAIN: u32 = 88;
/// How long a round measures.
const ROUND: Duration = Duration::from_millis(700);
/// How often who answers looks whether it is to end.
const LOOK: Duration = Duration::from_millis(20);

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let done = match &arguments.end {
        Some(job) => Job::begin(job).and_then(|job| end(&job)).map(|()| true),
        None => measure(&arguments),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("bench-rmw: {error}");
            ExitCode::FAILURE
        }
    }
}

/// One process of a round trip.
fn end(job: &Job) -> Result<()> {
    let (own, stop) = (job.clone(), stop_flag());
    // The RMW's threads inherit the priority, if it says nothing else of them.
    job.as_application(move || {
        let mut end = rmw::End::new(&own)?;
        match own.role {
            Role::Near => {
                if let Some(measured) = drive(&own, &mut end)? {
                    say(&Line::Measured(measured));
                }
                Ok(())
            }
            Role::Far => {
                say(&Line::Ready(None));
                answer(&mut end, &stop)
            }
        }
    })
}

fn answer(end: &mut impl Link, stop: &AtomicBool) -> Result<()> {
    while !stop.load(Ordering::Relaxed) {
        if let Some(number) = end.receive(LOOK)? {
            end.send(number)?;
        }
    }
    Ok(())
}

/// A process that says lines, until it is dropped.
struct Process(Child, BufReader<std::process::ChildStdout>);

impl Process {
    fn start(job: &Job, fast_dds: &str) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["--tautline", "none", "--end", &serde_json::to_string(job)?]);
        // What a user may have set is not what is measured.
        command
            .env_remove("RMW_IMPLEMENTATION")
            .env_remove("RUST_LOG")
            .env("FASTDDS_DEFAULT_PROFILES_FILE", fast_dds);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let output = child.stdout.take().ok_or("it says nothing")?;
        Ok(Process(child, BufReader::new(output)))
    }

    fn line(&mut self) -> Result<Line> {
        let mut line = String::new();
        self.1.read_line(&mut line)?;
        serde_json::from_str(&line)
            .map_err(|_| format!("a process ended without a word, or said: {line:?}").into())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        drop(self.0.stdin.take());
        let _ = self.0.wait();
    }
}

struct Row {
    system: &'static str,
    bytes: usize,
    held: bool,
    measured: Measured,
    steal_ticks: u64,
}

impl Row {
    fn new(system: &'static str, bytes: usize, held: bool) -> Self {
        Row { system, bytes, held, measured: Measured::default(), steal_ticks: 0 }
    }

    /// Another round, with processes of its own.
    fn add(&mut self, arguments: &Arguments, library: &Path, fast_dds: &str) -> Result<()> {
        let job = |role, core| Job {
            role,
            exchange: Exchange::RoundTrips,
            payload_bytes: self.bytes,
            budget: ROUND,
            core: Some(core),
            realtime: !arguments.no_rt,
            domain: DOMAIN,
            topic: format!("/bench_{}", self.bytes),
            endpoint: None,
            way: Way { mode: library.display().to_string(), ..Way::default() },
        };
        let before = host::steal_ticks(None);
        let mut far = Process::start(&job(Role::Far, 1), fast_dds)?;
        far.line()?;
        let mut near = Process::start(&job(Role::Near, 0), fast_dds)?;
        let Line::Measured(measured) = near.line()? else {
            return Err("the near end said something else".into());
        };
        self.measured.times_ns.extend(measured.times_ns);
        self.measured.lost += measured.lost;
        self.steal_ticks += host::steal_ticks(None) - before;
        Ok(())
    }

    /// In µs.
    fn percentile(&self, share: f64) -> f64 {
        let times = &self.measured.times_ns;
        let at = ((times.len() as f64 * share) as usize).min(times.len().saturating_sub(1));
        times.get(at).map_or(f64::NAN, |time| *time as f64 / 1e3)
    }

    fn to_json(&self) -> Value {
        json!({
            "system": self.system, "bytes": self.bytes, "idle_states_held_off": self.held,
            "n": self.measured.times_ns.len(), "lost": self.measured.lost, "p50_us": self.percentile(0.5),
            "p99_us": self.percentile(0.99), "p999_us": self.percentile(0.999), "max_us": self.percentile(1.0),
            "steal_ticks": self.steal_ticks,
        })
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (idle, n) = (if self.held { "held" } else { "as is" }, self.measured.times_ns.len());
        write!(f, "{:<18}{:>9}  {idle:<6}{n:>8}{:>6}", self.system, self.bytes, self.measured.lost)?;
        for share in [0.5, 0.99, 0.999, 1.0] {
            write!(f, "{:>9.1}", self.percentile(share))?;
        }
        write!(f, "{:>7}", self.steal_ticks)
    }
}

fn measure(arguments: &Arguments) -> Result<bool> {
    tautline_rt::domain::set_scope(&format!("bench_rmw_{}", std::process::id())).ok();
    let (rounds, sizes) = match arguments.quick {
        true => (1, vec![48, 1 << 20]),
        false => (7, vec![48, 64 << 10, 1 << 20, 8 << 20]),
    };
    let sizes = if arguments.bytes.is_empty() { sizes } else { arguments.bytes.clone() };
    let fast_dds = format!("{}/bench/fast_dds.xml", env!("CARGO_MANIFEST_DIR"));
    let systems = [("rmw_tautline", &*arguments.tautline), ("rmw_fastrtps_cpp", &*arguments.fast_dds)];
    let scope = tautline_rt::domain::scope()?.map(str::to_owned);
    let mut rows = Vec::new();
    println!(
        "half a round trip of rmw_wait and take, two processes, a core each{}, µs; 48 B: a struct; more: a serialized message",
        if arguments.no_rt { "" } else { ", SCHED_FIFO" }
    );
    println!(
        "{:<18}{:>9}  {:<6}{:>8}{:>6}{:>9}{:>9}{:>9}{:>9}{:>7}",
        "system", "bytes", "idle", "n", "lost", "p50", "p99", "p99.9", "max", "steal"
    );
    for held in [true, false] {
        let hold = if held { IdleHold::new().ok() } else { None };
        if held && hold.is_none() {
            println!("idle states cannot be held off here: /dev/cpu_dma_latency cannot be opened");
            continue;
        }
        for &bytes in &sizes {
            let mut found = systems.map(|(system, _)| Row::new(system, bytes, held));
            // In turns: what the machine does besides meets both.
            for _ in 0..rounds {
                for (row, (_, library)) in found.iter_mut().zip(systems) {
                    row.add(arguments, library, &fast_dds)?;
                }
            }
            for mut row in found {
                row.measured.times_ns.sort_unstable();
                println!("{row}");
                rows.push(row);
            }
        }
    }
    let claims = claims(&rows);
    for (claim, ratio, limit) in &claims {
        let verdict = if ratio <= limit { "holds" } else { "does not hold" };
        println!("{claim}: {ratio:.2} of Fast DDS's p50, {limit:.2} at most: {verdict}");
    }
    let lost: u64 = rows.iter().filter(|row| row.system == "rmw_tautline").map(|row| row.measured.lost).sum();
    println!("lost by rmw_tautline: {lost}");
    if let Some(path) = &arguments.json {
        let claims = claims
            .iter()
            .map(|(claim, ratio, limit)| json!({ "claim": claim, "ratio": ratio, "limit": limit }));
        let claims: Vec<Value> = claims.collect();
        let rows: Vec<Value> = rows.iter().map(Row::to_json).collect();
        let all = json!({ "rows": rows, "claims": claims, "scope": scope });
        std::fs::write(path, serde_json::to_string_pretty(&all)?)?;
    }
    Ok(lost == 0 && (arguments.quick || claims.iter().all(|(_, ratio, limit)| ratio <= limit)))
}

/// What is claimed of it, with idle states held off: how it compares, and what it may be.
fn claims(rows: &[Row]) -> Vec<(&'static str, f64, f64)> {
    let p50 = |system: &str, bytes: usize| {
        let row = rows.iter().find(|row| row.system == system && row.bytes == bytes && row.held)?;
        Some(row.percentile(0.5))
    };
    let of = |claim, bytes, limit| {
        let ratio = p50("rmw_tautline", bytes)? / p50("rmw_fastrtps_cpp", bytes)?;
        Some((claim, ratio, limit))
    };
    [of("48 B", 48, 0.5), of("1 MiB, serialized", 1 << 20, 1.0 / 3.0)].into_iter().flatten().collect()
}
