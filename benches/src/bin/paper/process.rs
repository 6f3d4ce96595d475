// SPDX-License-Identifier: MIT OR Apache-2.0
//! One run: a subscriber and a publisher process, and what they say.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use tautline_paper::{Job, Line, Measured, Published, Role};
use tautline_rt::host::steal_ticks;

use crate::Result;
use crate::plan::{Cell, Plan, System};

/// How long a process may take to set itself up, or to end.
const PATIENCE: Duration = Duration::from_secs(60);
/// How often an interrupt is looked for.
const GLANCE: Duration = Duration::from_millis(100);

/// What one run of a cell gave.
#[derive(Clone, Debug)]
pub struct Run {
    pub published: Published,
    pub measured: Measured,
    /// Ticks of 10 ms that the hypervisor took from the core during the run.
    pub steal_ticks: u64,
    /// It repeats a run that was disturbed.
    pub repetition: bool,
}

impl Run {
    /// Whether the core was taken away: by the hypervisor, or, as only the publisher at the highest priority could tell, by
    /// something else.
    pub fn is_disturbed(&self) -> bool {
        self.steal_ticks > 0 || self.published.missed > 0
    }
}

/// What r2r's program says that it is made of.
pub fn version(program: &Path) -> Result<String> {
    let output = Command::new(program).arg("--version").output()?;
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// Runs the cell once.
pub fn run(plan: &Plan, cell: Cell, namespace: String, interrupted: &AtomicBool) -> Result<Run> {
    let job = plan.job(cell, namespace);
    let program = program(plan, cell.system)?;
    let mut subscriber =
        Process::start(&program, &Job { role: Role::Subscriber, ..job.clone() }, interrupted)?;
    subscriber.expect(PATIENCE, |line| matches!(line, Line::Ready).then_some(()))?;
    let steal_before = steal_ticks(Some(plan.core));
    let mut publisher = Process::start(&program, &Job { role: Role::Publisher, ..job.clone() }, interrupted)?;
    let published = publisher.expect(PATIENCE + Duration::from_secs_f64(job.seconds), |line| match line {
        Line::Published(published) => Some(published),
        _ => None,
    })?;
    subscriber.tell(&serde_json::to_string(&published.messages)?)?;
    let measured = subscriber.expect(PATIENCE, |line| match line {
        Line::Measured(measured) => Some(measured),
        _ => None,
    })?;
    let steal_ticks = steal_ticks(Some(plan.core)).saturating_sub(steal_before);
    // The subscriber first: a publisher that is gone is noticed by those who listen.
    subscriber.finish()?;
    publisher.finish()?;
    Ok(Run { published, measured, steal_ticks, repetition: false })
}

fn program(plan: &Plan, system: System) -> Result<PathBuf> {
    match system {
        System::Tautline => Ok(std::env::current_exe()?),
        System::R2r => Ok(plan.r2r.clone()?),
    }
}

/// A process of a run; killed on drop if it still runs.
struct Process<'a> {
    role: Role,
    child: Child,
    lines: Receiver<Line>,
    interrupted: &'a AtomicBool,
}

impl<'a> Process<'a> {
    fn start(program: &Path, job: &Job, interrupted: &'a AtomicBool) -> Result<Self> {
        let mut child = Command::new(program)
            .arg("--child")
            .arg(serde_json::to_string(job)?)
            // Nothing of this leaves the machine.
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            // Ctrl-C is for the parent, which then kills its children.
            .process_group(0)
            .spawn()
            .map_err(|error| format!("{} cannot be started: {error}", program.display()))?;
        let output = child.stdout.take().ok_or("the output of the child is a pipe")?;
        let (sender, lines) = channel();
        thread::spawn(move || {
            for text in BufReader::new(output).lines().map_while(std::io::Result::ok) {
                // Ignored: not ours, or nobody listens after an error.
                let _ = serde_json::from_str(&text).map(|line| sender.send(line));
            }
        });
        Ok(Process { role: job.role, child, lines, interrupted })
    }

    /// Waits for the line that `pick` wants.
    fn expect<T>(&mut self, patience: Duration, pick: impl Fn(Line) -> Option<T>) -> Result<T> {
        let since = Instant::now();
        while since.elapsed() < patience {
            if self.interrupted.load(Ordering::Relaxed) {
                return Err("interrupted".into());
            }
            match self.lines.recv_timeout(GLANCE) {
                Ok(line) => {
                    if let Some(wanted) = pick(line) {
                        return Ok(wanted);
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    let words = self.last_words();
                    return Err(format!("the {:?} ended early: {words}", self.role).into());
                }
            }
        }
        let words = self.last_words();
        Err(format!("no answer from the {:?} in {} s: {words}", self.role, patience.as_secs()).into())
    }

    fn tell(&mut self, line: &str) -> Result<()> {
        let mut input = self.child.stdin.take().ok_or("the input of the child is a pipe")?;
        Ok(writeln!(input, "{line}")?)
    }

    /// Waits for the end, which must be a success.
    fn finish(&mut self) -> Result<()> {
        drop(self.child.stdin.take());
        let since = Instant::now();
        loop {
            match self.child.try_wait()? {
                Some(status) if status.success() => return Ok(()),
                Some(status) => {
                    let words = self.last_words();
                    return Err(format!("the {:?} failed ({status}): {words}", self.role).into());
                }
                None if since.elapsed() > PATIENCE => {
                    return Err(format!("the {:?} does not end", self.role).into());
                }
                None => thread::sleep(Duration::from_millis(5)),
            }
        }
    }

    /// Ends the process and returns what it wrote to standard error.
    fn last_words(&mut self) -> String {
        self.end();
        let mut words = String::new();
        // Ignored: then there are none.
        let _ = self.child.stderr.take().map(|mut error| error.read_to_string(&mut words));
        if words.trim().is_empty() { "no error stated".to_owned() } else { words.trim().to_owned() }
    }

    fn end(&mut self) {
        // Ignored: both fail only if the process has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for Process<'_> {
    fn drop(&mut self) {
        self.end();
    }
}
