// SPDX-License-Identifier: MIT OR Apache-2.0
//! Starts the three processes, waits for them, and takes what they tell.

use std::io::{BufRead, BufReader, IsTerminal, Read, stderr};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use indicatif::ProgressBar;
use tautline::rt::host::steal_ticks;
use tautline_alks::job::{Job, READY, Role, Shared};
use tautline_alks::records::Part;

use crate::report::{Bounds, Report};
use crate::{Options, Result, own_file, progress, sharing};

/// Longest time for a process to hear its topics, and, once it was told, to end.
const PATIENCE: Duration = Duration::from_secs(30);
/// Of comparisons, nobody else's; r2r's, too.
const DOMAIN: &str = "87";
/// Whether processes account for the time of their cores, by which `taut report` explains what was late.
const CORE_TIME: &str = "TAUT_CORE_TIME";
/// What in the environment would set a system otherwise than it is said.
const INHERITED: [&str; 10] = [
    "TAUT_DOMAIN",
    CORE_TIME,
    "TAUT_HOLD_IDLE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "RMW_FASTRTPS_PUBLICATION_MODE",
    "RMW_FASTRTPS_USE_QOS_FROM_XML",
    "ROS_DISCOVERY_SERVER",
    "ROS_STATIC_PEERS",
];

/// What is measured in turn.
struct Contestant {
    system: &'static str,
    program: PathBuf,
    job: Job,
    bounds: Option<Bounds>,
    parts: Vec<Vec<Part>>,
    steal_ticks: u64,
}

/// One run, or a comparison in rounds.
pub fn all(options: &Options, realtime: bool) -> Result<Vec<Report>> {
    let file = options.system.clone().unwrap_or_else(|| own_file("system.toml"));
    let bounds = Bounds::read(&file, realtime)?;
    let job = Job {
        role: Role::Adapter,
        seconds: options.seconds,
        seed: options.seed,
        realtime,
        shared: sharing(options.shared),
        system_file: Some(file),
    };
    let program = std::env::current_exe()?;
    let tautline = |shared: Shared| Contestant {
        system: "Tautline",
        program: program.clone(),
        job: Job { shared, ..job.clone() },
        bounds: Some(bounds.clone()),
        parts: Vec::new(),
        steal_ticks: 0,
    };
    let compares = options.r2r.is_some() || options.without_r2r.is_some();
    let mut contestants: Vec<_> =
        if compares { Shared::ALL.map(tautline).into() } else { vec![tautline(job.shared)] };
    if let Some(program) = &options.r2r {
        let job = Job { shared: Shared::Mutex, system_file: None, ..job };
        let (system, program, parts) = ("r2r over Fast DDS", program.clone(), Vec::new());
        contestants.push(Contestant { system, program, job, bounds: None, parts, steal_ticks: 0 });
    }
    let rounds = if compares { options.rounds } else { 1 };
    for round in 1..=rounds {
        // To and fro, so that a drift of the machine meets all.
        contestants.reverse();
        for contestant in &mut contestants {
            let what = format!("{}, {}", contestant.system, contestant.job.shared.as_str());
            let bar = progress("")?;
            bar.set_message(if rounds > 1 {
                format!("{what}, round {round} of {rounds}")
            } else {
                what.clone()
            });
            if !stderr().is_terminal() {
                eprintln!("{}: {:.0} s", bar.message(), contestant.job.seconds);
            }
            let before = steal_ticks(None);
            let parts = drive(&contestant.program, &contestant.job, compares, &bar);
            bar.finish_and_clear();
            contestant.parts.push(parts.map_err(|error| format!("{what}: {error}"))?);
            contestant.steal_ticks += steal_ticks(None).saturating_sub(before);
        }
    }
    if rounds % 2 == 1 {
        contestants.reverse();
    }
    if let Some(reason) = &options.without_r2r {
        eprintln!("r2r LEFT OUT: {reason}");
    }
    contestants
        .into_iter()
        .map(|of| Report::new(of.system, &of.job, &of.parts, of.bounds.as_ref(), of.steal_ticks))
        .collect()
}

/// The three processes of one run: their words in the order of [`Role`]. Not `apart` they are in the domain of the environment, where tools
/// find them.
fn drive(program: &Path, job: &Job, apart: bool, bar: &ProgressBar) -> Result<Vec<Part>> {
    let mut visualizer = Process::start(program, job, Role::Visualizer, apart)?;
    let mut alks = Process::start(program, job, Role::Alks, apart)?;
    for process in [&mut visualizer, &mut alks] {
        process.expect_ready()?;
    }
    let begin = Instant::now();
    let adapter = Process::start(program, job, Role::Adapter, apart)?;
    let limit = Duration::from_secs_f64(job.seconds) + PATIENCE;
    let told = adapter.part(limit, |since| {
        bar.set_position((since.as_secs_f64() / (job.seconds + 1.5) * 1000.0) as u64);
    });
    let driven = told.map_err(|error| format!("after {:.1} s: {error}", begin.elapsed().as_secs_f64()))?;
    // The last messages are on their way no longer when the adapter has ended.
    let parts = [alks, visualizer].map(|mut process| {
        process.child.stdin.take();
        process.part(PATIENCE, |_| {})
    });
    let [alks, visualizer] = parts;
    Ok(vec![driven, alks?, visualizer?])
}

struct Process {
    role: Role,
    child: Child,
    lines: Receiver<String>,
}

impl Process {
    fn start(program: &Path, job: &Job, role: Role, apart: bool) -> Result<Process> {
        let mut command = Command::new(program);
        command.arg("--child").arg(serde_json::to_string(&Job { role, ..job.clone() })?);
        if apart {
            INHERITED.iter().for_each(|name| {
                command.env_remove(name);
            });
            // r2r would look for others in the whole network, and hear whoever publishes the same topics.
            command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST").env("ROS_DOMAIN_ID", DOMAIN);
        } else if std::env::var_os(CORE_TIME).is_none() {
            command.env(CORE_TIME, "on");
        }
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut child = child.map_err(|error| format!("{}: {error}", program.display()))?;
        let lines = read(child.stdout.take().ok_or("a process without output")?);
        Ok(Process { role, child, lines })
    }

    fn expect_ready(&mut self) -> Result<()> {
        match self.lines.recv_timeout(PATIENCE) {
            Ok(line) if line == READY => Ok(()),
            Ok(line) => Err(format!("the {:?} process says '{line}' instead of '{READY}'", self.role).into()),
            Err(_) => Err(format!("the {:?} process does not come up within {PATIENCE:?}", self.role).into()),
        }
    }

    /// Waits for its last word and its end.
    fn part(mut self, limit: Duration, mut progress: impl FnMut(Duration)) -> Result<Part> {
        let since = Instant::now();
        let line = loop {
            match self.lines.recv_timeout(Duration::from_millis(200)) {
                Ok(line) => break line,
                Err(std::sync::mpsc::RecvTimeoutError::Timeout) if since.elapsed() < limit => {
                    progress(since.elapsed());
                }
                Err(_) => {
                    return Err(format!("the {:?} process ends without a word: see above", self.role).into());
                }
            }
        };
        let part =
            serde_json::from_str(&line).map_err(|error| format!("the {:?} process: {error}", self.role))?;
        let status = self.child.wait()?;
        if !status.success() {
            return Err(format!("the {:?} process: {status}", self.role).into());
        }
        Ok(part)
    }
}

impl Drop for Process {
    /// Whatever went wrong, none is left.
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Lines as they come; the end of the channel is that of the process's output.
fn read(output: ChildStdout) -> Receiver<String> {
    let (sender, lines) = channel();
    std::thread::spawn(move || {
        let mut output = BufReader::new(output);
        let mut line = String::new();
        while output.by_ref().read_line(&mut line).is_ok_and(|read| read > 0) {
            if sender.send(line.trim_end().to_owned()).is_err() {
                return;
            }
            line.clear();
        }
    });
    lines
}
