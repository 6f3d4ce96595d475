// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the bridge costs: many topics at a high rate, each way, with a subscription on both sides of it in the same run.
//!
//! One process publishes, on one side; one subscribes with r2r and one with Tautline. One of both gets the messages
//! directly, the other through the bridge: the difference is what the bridge adds. A message is its time of publication.

mod ends;
mod report;

use clap::Parser;
use ends::{Job, Role, Side};
use report::{Phase, Received};
use std::error::Error;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::Duration;
use tautline_bridge_ros::Direction;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Measures the bridge beside r2r's own subscriber.
#[derive(Parser, Debug)]
#[command(after_help = "Examples:
  cargo xtask bench bridge                  20 topics at 1 kHz, 30 s each way
  cargo xtask bench bridge --quick          2 s each way
  cargo xtask bench bridge -- --topics 5 --rate 100 --no-rt")]
struct Args {
    /// Topics
    #[arg(long, default_value_t = 20)]
    topics: usize,
    /// Messages per second of each
    #[arg(long, value_name = "HZ", default_value_t = 1000)]
    rate: u32,
    /// Length of a phase; there is one each way
    #[arg(long, value_name = "S", default_value_t = 30)]
    seconds: u32,
    /// The bridge [default: the one beside this program]
    #[arg(long, value_name = "PROGRAM")]
    bridge: Option<PathBuf>,
    /// Domain of Tautline and of ROS
    #[arg(long, value_name = "N", default_value_t = 77)]
    domain: u32,
    /// The bridge runs without real-time priorities
    #[arg(long)]
    no_rt: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
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
    let mut phases = Vec::new();
    for direction in [Direction::FromRos, Direction::ToRos] {
        phases.push(phase(args, direction)?);
    }
    report::print(&phases, args.topics, args.rate, args.seconds);
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&phases)?)?;
    }
    if phases.iter().any(|phase| phase.lost() > 0) {
        return Err("messages were lost".into());
    }
    Ok(())
}

fn phase(args: &Args, direction: Direction) -> Result<Phase> {
    let own = std::env::current_exe()?;
    let bridge = args.bridge.clone().unwrap_or_else(|| own.with_file_name("taut-bridge-ros"));
    let domain = args.domain.to_string();
    let mut command = Command::new(bridge);
    command.args(["--domain", &domain, "--ros-domain", &domain, "--json"]).stdout(Stdio::null());
    if args.no_rt {
        command.arg("--no-rt");
    }
    let bridge = Ended(command.spawn()?);
    let job = |side, role| Job {
        side,
        role,
        topics: args.topics,
        rate: args.rate,
        messages: args.rate * args.seconds,
        domain: args.domain,
    };
    let side = if direction == Direction::FromRos { Side::Ros } else { Side::Tautline };
    let mut ros = Peer::start(&job(Side::Ros, Role::Subscriber), &domain)?;
    let mut tautline = Peer::start(&job(Side::Tautline, Role::Subscriber), &domain)?;
    let mut publisher = Peer::start(&job(side, Role::Publisher), &domain)?;
    publisher.expect("matched")?;
    let before = cpu_s(bridge.0.id())?;
    publisher.tell("go")?;
    let progress = indicatif::ProgressBar::new_spinner();
    progress.set_message(format!(
        "{direction:?}: {} topics at {} Hz for {} s",
        args.topics, args.rate, args.seconds
    ));
    progress.enable_steady_tick(Duration::from_millis(100));
    publisher.expect("published")?;
    let cpu_s = cpu_s(bridge.0.id())? - before;
    let expected = args.topics as u64 * u64::from(args.rate) * u64::from(args.seconds);
    let ros: Received = serde_json::from_str(&ros.last_word()?)?;
    let tautline: Received = serde_json::from_str(&tautline.last_word()?)?;
    progress.finish_and_clear();
    let (direct, bridged) = if side == Side::Ros { (ros, tautline) } else { (tautline, ros) };
    Ok(Phase {
        direction,
        expected,
        direct,
        bridged,
        bridge_cpu_percent: 100.0 * cpu_s / f64::from(args.seconds),
    })
}

/// Processor time that a process has used: fields 14 and 15 of its stat, in hundredths of a second.
fn cpu_s(pid: u32) -> Result<f64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat"))?;
    let fields = stat.rsplit_once(')').ok_or("no stat")?.1.split_whitespace();
    let ticks: Vec<f64> = fields.skip(11).take(2).map(str::parse).collect::<std::result::Result<_, _>>()?;
    Ok(ticks.iter().sum::<f64>() / rustix::param::clock_ticks_per_second() as f64)
}

/// A process that ends when this is dropped.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

struct Peer {
    process: Ended,
    output: BufReader<std::process::ChildStdout>,
}

impl Peer {
    fn start(job: &Job, ros_domain: &str) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("--child").arg(serde_json::to_string(job)?).env("ROS_DOMAIN_ID", ros_domain);
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
