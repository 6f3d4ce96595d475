// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process that measures, and what it says.

use std::error::Error;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde::de::DeserializeOwned;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// How long a process may take to end.
const PATIENCE: Duration = Duration::from_secs(60);
/// How often an interrupt is looked for.
const GLANCE: Duration = Duration::from_millis(100);

/// A process that says lines of JSON, each a `L`; killed on drop if it still runs.
#[derive(Debug)]
pub struct Process<'a, L> {
    name: String,
    child: Child,
    lines: Receiver<L>,
    interrupted: &'a AtomicBool,
}

impl<'a, L: DeserializeOwned + Send + 'static> Process<'a, L> {
    /// Starts it; `name` is what errors call it. Waiting for it ends when `interrupted` is set.
    ///
    /// # Errors
    /// It cannot be started.
    pub fn start(
        command: &mut Command,
        name: impl Into<String>,
        interrupted: &'a AtomicBool,
    ) -> Result<Self> {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            // Ctrl-C is for the parent, which then kills its children.
            .process_group(0)
            .spawn()
            .map_err(|error| format!("{} cannot be started: {error}", command.get_program().display()))?;
        let output = child.stdout.take().ok_or("the output of the child is a pipe")?;
        let (sender, lines) = channel();
        thread::spawn(move || {
            for text in BufReader::new(output).lines().map_while(std::io::Result::ok) {
                // Ignored: not ours, or nobody listens after an error.
                let _ = serde_json::from_str(&text).map(|line| sender.send(line));
            }
        });
        Ok(Process { name: name.into(), child, lines, interrupted })
    }

    /// Waits for the line that `pick` wants.
    ///
    /// # Errors
    /// It ended, it was interrupted, or `patience` was not enough.
    pub fn expect<T>(&mut self, patience: Duration, pick: impl Fn(L) -> Option<T>) -> Result<T> {
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
                    return Err(format!("the {} ended early: {words}", self.name).into());
                }
            }
        }
        let words = self.last_words();
        Err(format!("no answer from the {} in {} s: {words}", self.name, patience.as_secs()).into())
    }

    /// The last line that it has said so far.
    pub fn latest(&mut self) -> Option<L> {
        self.lines.try_iter().last()
    }

    /// Writes a line to its standard input, and closes it.
    ///
    /// # Errors
    /// It has closed its end.
    pub fn tell(&mut self, line: &str) -> Result<()> {
        let mut input = self.child.stdin.take().ok_or("the input of the child is a pipe")?;
        Ok(writeln!(input, "{line}")?)
    }

    /// Closes its standard input and waits for the end, which must be a success.
    ///
    /// # Errors
    /// It failed, or does not end.
    pub fn finish(&mut self) -> Result<()> {
        drop(self.child.stdin.take());
        let since = Instant::now();
        loop {
            match self.child.try_wait()? {
                Some(status) if status.success() => return Ok(()),
                Some(status) => {
                    let words = self.last_words();
                    return Err(format!("the {} failed ({status}): {words}", self.name).into());
                }
                None if since.elapsed() > PATIENCE => {
                    return Err(format!("the {} does not end", self.name).into());
                }
                None => thread::sleep(Duration::from_millis(5)),
            }
        }
    }

    /// Asks it to end, as a terminal does, and kills it if it does not within a second.
    pub fn terminate(&mut self) {
        let patience = Duration::from_secs(1);
        if let Some(pid) = Pid::from_raw(self.child.id().cast_signed()) {
            // Ignored: it has ended.
            let _ = kill_process(pid, Signal::TERM);
        }
        let since = Instant::now();
        while since.elapsed() < patience && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(Duration::from_millis(5));
        }
        end(&mut self.child);
    }

    /// Its number.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Ends the process and returns what it wrote to standard error.
    fn last_words(&mut self) -> String {
        end(&mut self.child);
        let mut words = String::new();
        // Ignored: then there are none.
        let _ = self.child.stderr.take().map(|mut error| error.read_to_string(&mut words));
        if words.trim().is_empty() { "no error stated".to_owned() } else { words.trim().to_owned() }
    }
}

fn end(child: &mut Child) {
    // Ignored: both fail only if the process has ended.
    let _ = child.kill();
    let _ = child.wait();
}

impl<L> Drop for Process<'_, L> {
    fn drop(&mut self) {
        end(&mut self.child);
    }
}
