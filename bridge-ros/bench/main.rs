// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the bridge costs: many topics at a high rate, each way, with a subscription on both sides of it in the same run.
//!
//! One process publishes, on one side; one subscribes with r2r and one with Tautline. One of both gets the messages
//! directly, the other through the bridge: the difference is what the bridge adds. A message is its number and its time of
//! publication.

mod ends;
mod report;

use clap::Parser;
use clap::builder::RangedU64ValueParser;
use ends::{Job, MAX_MESSAGES, Role, Side};
use report::{Cpu, Phase, Received};
use rustix::process::{Pid, Signal};
use std::error::Error;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::{Duration, Instant};
use tautline_bridge_ros::Direction;
use tautline_rt::clock::monotonic_ns;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Measures the bridge beside r2r's own subscriber.
#[derive(Parser, Debug)]
#[command(after_help = "Examples:
  cargo xtask bench bridge                  20 topics at 1 kHz, 30 s each way
  cargo xtask bench bridge --quick          2 s each way
  cargo xtask bench bridge -- --fit         on a machine that has no room for this to ROS
  cargo xtask bench bridge -- --topics 5 --rate 100 --no-rt")]
struct Args {
    /// Topics
    #[arg(long, default_value_t = 20, value_parser = RangedU64ValueParser::<usize>::new().range(1..))]
    topics: usize,
    /// Messages per second of each
    #[arg(long, value_name = "HZ", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..))]
    rate: u32,
    /// Length of a phase; there is one each way
    #[arg(long, value_name = "S", default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..))]
    seconds: u32,
    /// The bridge [default: the one beside this program]
    #[arg(long, value_name = "PROGRAM")]
    bridge: Option<PathBuf>,
    /// Domain of Tautline and of ROS
    #[arg(long, value_name = "N", default_value_t = 77)]
    domain: u32,
    /// To ROS at no more than what would keep the machine 50 % busy from ROS: a message to ROS costs more, and what a machine cannot
    /// carry is lost where Fast DDS's queues are full
    #[arg(long)]
    fit: bool,
    /// The bridge runs without real-time priorities
    #[arg(long)]
    no_rt: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Fast DDS with its default shared memory, which is short of room on a small machine
    #[arg(long)]
    fast_dds_default: bool,
    /// For this program itself
    #[arg(long, hide = true)]
    child: Option<String>,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let outcome = match &args.child {
        Some(job) => ends::run(job),
        None => measure(&args),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("bench-bridge: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(args: &Args) -> Result<()> {
    if args.rate.checked_mul(args.seconds).is_none_or(|messages| messages > MAX_MESSAGES) {
        return Err(format!("more than {MAX_MESSAGES} messages of a topic: lower --rate or --seconds").into());
    }
    let profile = (!args.fast_dds_default).then(Profile::write).transpose()?;
    let from_ros = phase(args, Direction::FromRos, args.rate, profile.as_ref())?;
    let rate = if args.fit { args.rate.min(from_ros.rate_that_fits()) } else { args.rate };
    let to_ros = phase(args, Direction::ToRos, rate, profile.as_ref())?;
    let phases = [from_ros, to_ros];
    report::print(&phases, args.topics);
    if profile.is_some() {
        println!(
            "Fast DDS had shared memory for a second of messages (--fast-dds-default: what it has by itself)"
        );
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&phases)?)?;
    }
    let faults: Vec<String> = phases.iter().filter_map(Phase::fault).collect();
    if faults.is_empty() { Ok(()) } else { Err(faults.join("; ").into()) }
}

/// As many messages as `args` ask for, at this rate.
fn phase(args: &Args, direction: Direction, rate: u32, profile: Option<&Profile>) -> Result<Phase> {
    let own = std::env::current_exe()?;
    let bridge = args.bridge.clone().unwrap_or_else(|| own.with_file_name("taut-bridge-ros"));
    let domain = args.domain.to_string();
    let mut command = Command::new(bridge);
    command.args(["--domain", &domain, "--ros-domain", &domain, "--json"]).stdout(Stdio::null());
    if args.no_rt {
        command.arg("--no-rt");
    }
    command.envs(profile.map(Profile::variable));
    let bridge = Ended(command.spawn()?);
    let epoch_ns = monotonic_ns();
    let messages = args.rate * args.seconds;
    let job =
        |side, role| Job { side, role, topics: args.topics, rate, messages, domain: args.domain, epoch_ns };
    let side = if direction == Direction::FromRos { Side::Ros } else { Side::Tautline };
    let other = if side == Side::Ros { Side::Tautline } else { Side::Ros };
    let start = |job: Job| Peer::start(&job, &domain, profile);
    let mut direct = start(job(side, Role::Subscriber))?;
    let mut bridged = start(job(other, Role::Subscriber))?;
    let mut publisher = start(job(side, Role::Publisher))?;
    publisher.expect("matched")?;
    let pids = [bridge.0.id(), direct.process.0.id(), bridged.process.0.id(), publisher.process.0.id()];
    let cpu = CpuMeter::start(pids)?;
    publisher.tell("go")?;
    let progress = indicatif::ProgressBar::new_spinner();
    progress.set_message(format!(
        "{direction:?}: {} topics at {rate} Hz for {} s",
        args.topics,
        messages / rate
    ));
    progress.enable_steady_tick(Duration::from_millis(100));
    publisher.expect("published")?;
    let (published_s, cpu) = cpu.end()?;
    let expected = args.topics as u64 * u64::from(messages);
    let direct: Received = serde_json::from_str(&direct.last_word()?)?;
    let bridged: Received = serde_json::from_str(&bridged.last_word()?)?;
    progress.finish_and_clear();
    Ok(Phase { direction, rate, messages, expected, direct, bridged, published_s, cpu })
}

/// Processor time of the bridge, both subscribers and the publisher, and of the whole machine.
struct CpuMeter {
    pids: [u32; 4],
    since: Instant,
    used_s: [f64; 4],
    machine: [f64; 2],
}

impl CpuMeter {
    fn start(pids: [u32; 4]) -> Result<Self> {
        Ok(CpuMeter { pids, since: Instant::now(), used_s: used_s(pids)?, machine: machine_ticks()? })
    }

    /// How long it was, in seconds, and what was used.
    fn end(self) -> Result<(f64, Cpu)> {
        let elapsed_s = self.since.elapsed().as_secs_f64();
        let (used_s, machine) = (used_s(self.pids)?, machine_ticks()?);
        let [bridge, direct, bridged, publisher] =
            std::array::from_fn(|index| 100.0 * (used_s[index] - self.used_s[index]) / elapsed_s);
        let [busy, all] = std::array::from_fn(|index| machine[index] - self.machine[index]);
        let cpu = Cpu { bridge, direct, bridged, publisher, machine: 100.0 * busy / all.max(1.0) };
        Ok((elapsed_s, cpu))
    }
}

fn used_s(pids: [u32; 4]) -> Result<[f64; 4]> {
    let mut used_s = [0.0; 4];
    for (used_s, pid) in used_s.iter_mut().zip(pids) {
        *used_s = cpu_s(pid)?;
    }
    Ok(used_s)
}

/// Of all cores: in use, and in all.
fn machine_ticks() -> Result<[f64; 2]> {
    let stat = std::fs::read_to_string("/proc/stat")?;
    // user, nice, system, idle, iowait, irq, softirq, steal; guests' are within user.
    let ticks = stat.lines().next().unwrap_or_default().split_whitespace().skip(1).take(8).map(str::parse);
    let ticks: Vec<f64> = ticks.collect::<std::result::Result<_, _>>()?;
    let all: f64 = ticks.iter().sum();
    let idle: f64 = ticks.iter().skip(3).take(2).sum();
    Ok([all - idle, all])
}

/// Of a process: fields 14 and 15 of its stat, in hundredths of a second.
fn cpu_s(pid: u32) -> Result<f64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat"))?;
    let fields = stat.rsplit_once(')').ok_or("no stat")?.1.split_whitespace();
    let ticks: Vec<f64> = fields.skip(11).take(2).map(str::parse).collect::<std::result::Result<_, _>>()?;
    Ok(ticks.iter().sum::<f64>() / rustix::param::clock_ticks_per_second() as f64)
}

/// What Fast DDS reads: a file as long as this lives.
struct Profile(PathBuf);

impl Profile {
    fn write() -> Result<Self> {
        let path = std::env::temp_dir().join(format!("bench-bridge-{}.xml", std::process::id()));
        std::fs::write(&path, include_str!("fast_dds.xml"))?;
        Ok(Profile(path))
    }

    fn variable(&self) -> (&'static str, &PathBuf) {
        ("FASTRTPS_DEFAULT_PROFILES_FILE", &self.0)
    }
}

impl Drop for Profile {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// A process that ends when this is dropped: with its input, or by a signal. One that is killed leaves what it had in shared memory.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        const PATIENCE: Duration = Duration::from_secs(5);
        if self.0.stdin.take().is_none() {
            let _ = rustix::process::kill_process(Pid::from_child(&self.0), Signal::TERM);
        }
        let since = Instant::now();
        while matches!(self.0.try_wait(), Ok(None)) && since.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

struct Peer {
    process: Ended,
    output: BufReader<std::process::ChildStdout>,
}

impl Peer {
    fn start(job: &Job, ros_domain: &str, profile: Option<&Profile>) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("--child").arg(serde_json::to_string(job)?).env("ROS_DOMAIN_ID", ros_domain);
        command.envs(profile.map(Profile::variable));
        let mut process = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let output = BufReader::new(process.stdout.take().ok_or("no output")?);
        let mut peer = Peer { process: Ended(process), output };
        peer.expect("ready")?;
        Ok(peer)
    }

    fn line(&mut self) -> Result<String> {
        let mut line = String::new();
        if self.output.read_line(&mut line)? == 0 {
            return Err("a process ended: see what it said above".into());
        }
        Ok(line.trim().to_owned())
    }

    fn expect(&mut self, word: &str) -> Result<()> {
        let line = self.line()?;
        if line == word { Ok(()) } else { Err(format!("'{line}' instead of '{word}'").into()) }
    }

    fn tell(&mut self, word: &str) -> Result<()> {
        let input = self.process.0.stdin.as_mut().ok_or("no input")?;
        Ok(writeln!(input, "{word}")?)
    }

    /// Tells it to end, and what it says then.
    fn last_word(&mut self) -> Result<String> {
        self.tell("end")?;
        self.line()
    }
}
