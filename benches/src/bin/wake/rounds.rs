// SPDX-License-Identifier: MIT OR Apache-2.0
//! The parent: starts the pairs in alternating rounds and merges what they measured.

use std::io::{BufRead, BufReader};
use std::os::fd::OwnedFd;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use tautline_benches::rows::{Row, Tally};
use tautline_benches::{Distribution, Disturbance, Scratch, progress_bar};
use tautline_rt::IdleHold;
use tautline_rt::domain::scope;

use crate::child::{Measured, READY};
use crate::plan::{Idle, Job, Mode, Payload, Plan, Role};
use crate::report::Rows;
use crate::{Result, futex};

/// What the parent waits for.
enum Event {
    /// A line of a child of pair `.0`; `None` when it closed its output.
    Line(u32, Role, Option<String>),
    Interrupt,
}

/// Measures everything in the plan.
pub fn run(plan: &Plan) -> Result<Rows> {
    let scratch = Scratch::new("wake")?;
    let (sender, events) = channel();
    interrupt_on_signal(sender.clone())?;
    let mut parent = Parent { plan, scratch: &scratch, sender, events, pair: 0 };

    let mut cells = cells(plan);
    let disturbance = Disturbance::start();
    let mut idle_refused = None;
    let progress = progress_bar(plan.runs().into());
    for round in 1..=plan.rounds {
        // To and fro, so that a drift of the machine meets all rivals.
        cells.reverse();
        for cell in &mut cells {
            let (system, mode) = cell.mode.names();
            progress.set_message(format!("round {round}: {system} {mode}, {} B", cell.payload.bytes));
            // Taken and released for each pair: rivals run side by side, and no other round is affected.
            let hold = match cell.idle {
                Idle::Default => None,
                Idle::Poll => match IdleHold::new() {
                    Ok(hold) => Some(hold),
                    Err(error) => {
                        idle_refused = Some(error.to_string());
                        progress.inc(1);
                        continue;
                    }
                },
            };
            let measured = parent.measure(cell.mode, cell.payload).map_err(|error| {
                format!("{system} {mode}, {} B, round {round}: {error}", cell.payload.bytes)
            })?;
            drop(hold);
            cell.add(round, &measured);
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    cells.sort_by_key(|cell| cell.position);
    let rows = cells.iter().filter(|cell| !cell.tally.times.is_empty()).map(Cell::row).collect();
    Ok(Rows { rows, disturbance: disturbance.report(), idle_refused })
}

/// A line of the result in the making.
struct Cell {
    /// Its place in the report.
    position: usize,
    mode: Mode,
    payload: Payload,
    idle: Idle,
    tally: Tally,
}

/// All cells, rivals next to each other.
fn cells(plan: &Plan) -> Vec<Cell> {
    let mut cells = Vec::new();
    for idle in Idle::ALL {
        for &payload in &plan.payloads {
            for &mode in &plan.modes {
                let (position, tally) = (cells.len(), Tally::default());
                cells.push(Cell { position, mode, payload, idle, tally });
            }
        }
    }
    cells
}

impl Cell {
    fn add(&mut self, round: u32, measured: &Measured) {
        let mut times = Distribution::new();
        times.add(&measured.counts);
        self.tally.add(round, &times);
        self.tally.lost += measured.lost;
    }

    fn row(&self) -> Row {
        let (system, mode) = self.mode.names();
        self.tally.row(self.idle.experiment(self.payload.touched), system, mode, self.payload.bytes)
    }
}

struct Parent<'a> {
    plan: &'a Plan,
    scratch: &'a Scratch,
    sender: Sender<Event>,
    events: Receiver<Event>,
    /// The pair that runs: events of earlier ones are stale.
    pair: u32,
}

impl Parent<'_> {
    /// Runs one pair of processes to its end.
    fn measure(&mut self, mode: Mode, payload: Payload) -> Result<Measured> {
        self.pair += 1;
        let [sender, receiver] = self.plan.cores;
        let job = Job {
            role: Role::Pong,
            mode,
            payload,
            budget: self.plan.budget(),
            cores: if mode.is_one_core() { [receiver; 2] } else { [sender, receiver] },
            realtime: self.plan.realtime,
            pair: self.pair,
            prefix: self.scratch.prefix().to_owned(),
            directory: self.scratch.directory().to_owned(),
        };
        let memory = futex::memory(payload)?;
        let mut pong = self.spawn(&job, memory.try_clone()?)?;
        let ready = self.next_line(Role::Pong)?;
        if ready.as_deref() != Some(READY) {
            return Err(
                format!("the answering process ended before it was ready: {}", pong.last_words()).into()
            );
        }
        let mut ping = self.spawn(&Job { role: Role::Ping, ..job }, memory)?;
        let Some(line) = self.next_line(Role::Ping)? else {
            // Either of them may have been the first to fail.
            let (asking, answering) = (ping.last_words(), pong.last_words());
            return Err(
                format!("the exchange ended without a result: {asking}; its peer: {answering}").into()
            );
        };
        ping.finish()?;
        pong.finish()?;
        Ok(serde_json::from_str(&line)?)
    }

    fn spawn(&self, job: &Job, memory: OwnedFd) -> Result<Peer> {
        let mut child = Command::new(std::env::current_exe()?)
            .arg("--child")
            .arg(serde_json::to_string(job)?)
            .envs(scope()?.map(|scope| ("TAUT_SCOPE", scope)))
            .stdin(memory)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            // Ctrl-C is for the parent, which then kills its children.
            .process_group(0)
            .spawn()?;
        let output = child.stdout.take().ok_or("the output of the child is a pipe")?;
        let (sender, pair, role) = (self.sender.clone(), self.pair, job.role);
        thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(std::io::Result::ok) {
                // Ignored: nobody listens after an error.
                let _ = sender.send(Event::Line(pair, role, Some(line)));
            }
            let _ = sender.send(Event::Line(pair, role, None));
        });
        Ok(Peer { child })
    }

    /// The next line of `role`; `None` if it ended.
    fn next_line(&self, role: Role) -> Result<Option<String>> {
        let limit = self.plan.budget() * 2 + Duration::from_secs(10);
        loop {
            match self.events.recv_timeout(limit) {
                Ok(Event::Line(pair, from, line)) if pair == self.pair && from == role => return Ok(line),
                Ok(Event::Line(..)) => {}
                Ok(Event::Interrupt) => return Err("interrupted".into()),
                Err(_) => return Err(format!("no answer from the {role:?} process in {limit:?}").into()),
            }
        }
    }
}

/// A process of a pair; killed on drop if it still runs.
struct Peer {
    child: Child,
}

impl Peer {
    /// Waits for the end, which must be a success.
    fn finish(&mut self) -> Result<()> {
        let status = self.child.wait()?;
        if status.success() {
            return Ok(());
        }
        Err(format!("a process ended with {status}: {}", self.last_words()).into())
    }

    /// Ends the process and returns what it wrote to standard error.
    fn last_words(&mut self) -> String {
        self.end();
        let words = self.child.stderr.take().map(std::io::read_to_string);
        match words {
            Some(Ok(words)) if !words.trim().is_empty() => words.trim().to_owned(),
            _ => "no error stated".to_owned(),
        }
    }

    fn end(&mut self) {
        // Ignored: both fail only if the process has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.end();
    }
}

/// Turns Ctrl-C and SIGTERM into an event, so that children are killed and files removed; the second one ends at once.
fn interrupt_on_signal(sender: Sender<Event>) -> Result<()> {
    let mut signals = Signals::new([SIGINT, SIGTERM])?;
    thread::spawn(move || {
        let mut signals = signals.forever();
        signals.next();
        // Ignored: then the run has ended.
        let _ = sender.send(Event::Interrupt);
        signals.next();
        std::process::exit(130);
    });
    Ok(())
}
