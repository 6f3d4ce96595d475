// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process that measures, and what it says.

use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};
use serde::de::DeserializeOwned;
use tautline_rt::domain::scope;

use crate::{Error, Result};

/// How long a process may take to end.
const PATIENCE: Duration = Duration::from_secs(60);
/// How long one that was killed may take to end. Threads that share a core and a real-time priority wait for each other.
const DYING: Duration = Duration::from_secs(2);
/// How often an interrupt is looked for.
const GLANCE: Duration = Duration::from_millis(100);

/// What in the environment would set a system otherwise than a report says.
const SETTINGS: [&str; 17] = [
    "CYCLONEDDS_URI",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_ENVIRONMENT_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "RMW_FASTRTPS_PUBLICATION_MODE",
    "RMW_FASTRTPS_USE_QOS_FROM_XML",
    "RMW_IMPLEMENTATION",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_DISCOVERY_SERVER",
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
    "TAUT_CORE_TIME",
    "TAUT_OVERHEADS",
    "TAUT_DOMAIN",
    "TAUT_HOLD_IDLE",
    "ZENOH_CONFIG",
];

/// Removes the user's settings of all systems from a command's environment.
pub fn without_settings(command: &mut Command) -> &mut Command {
    SETTINGS.iter().fold(command, |command, name| command.env_remove(name))
}

/// A process that says lines of JSON, each a `L`; killed on drop if it still runs. If the thread that starts it ends first, however
/// that may be, it is asked to end, too.
#[derive(Debug)]
pub struct Process<'a, L> {
    name: String,
    child: Child,
    /// What it says, or a line that should have been one and is none.
    lines: Receiver<std::result::Result<L, String>>,
    /// Reads what it writes to standard error, all the time: a full pipe would hold it up.
    errors: Option<JoinHandle<Vec<u8>>>,
    interrupted: &'a AtomicBool,
}

impl<'a, L: DeserializeOwned + Send + 'static> Process<'a, L> {
    /// Starts it, in this one's scope; `name` is what errors call it. Waiting for it ends when `interrupted` is set.
    pub fn start(
        command: &mut Command,
        name: impl Into<String>,
        interrupted: &'a AtomicBool,
    ) -> Result<Self> {
        command.envs(scope()?.map(|scope| ("TAUT_SCOPE", scope)));
        // SAFETY: between fork and exec it does a system call and nothing else.
        unsafe { command.pre_exec(|| Ok(set_parent_process_death_signal(Some(Signal::TERM))?)) };
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
                let line = match serde_json::from_str(&text) {
                    Ok(line) => Ok(line),
                    Err(error) if text.starts_with('{') => Err(format!("{error} in its line {text:.200}")),
                    // Not ours: a library's.
                    Err(_) => continue,
                };
                // Ignored: nobody listens after an error.
                let _ = sender.send(line);
            }
        });
        let error = child.stderr.take().ok_or("the errors of the child are a pipe")?;
        let errors = Some(thread::spawn(move || last_bytes(error)));
        Ok(Process { name: name.into(), child, lines, errors, interrupted })
    }

    /// Waits for the line that `pick` wants.
    ///
    /// # Errors
    /// It ended, it was interrupted, or `patience` was not enough.
    pub fn expect<T>(&mut self, patience: Duration, pick: impl Fn(L) -> Option<T>) -> Result<T> {
        if let Some(wanted) = self.wait_for(patience, pick)? {
            return Ok(wanted);
        }
        let words = self.last_words();
        Err(format!("no answer from the {} in {} s: {words}", self.name, patience.as_secs()).into())
    }

    /// As [`expect`](Self::expect), but it may stay silent.
    ///
    /// # Errors
    /// It ended, or it was interrupted.
    pub fn wait_for<T>(&mut self, patience: Duration, pick: impl Fn(L) -> Option<T>) -> Result<Option<T>> {
        let since = Instant::now();
        loop {
            if self.interrupted.load(Ordering::Relaxed) {
                return Err("interrupted".into());
            }
            let left = patience.saturating_sub(since.elapsed());
            match self.lines.recv_timeout(left.min(GLANCE)) {
                Ok(Ok(line)) => {
                    if let Some(wanted) = pick(line) {
                        return Ok(Some(wanted));
                    }
                }
                Ok(Err(error)) => return Err(format!("the {} is not understood: {error}", self.name).into()),
                Err(RecvTimeoutError::Timeout) if left.is_zero() => return Ok(None),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(self.ended_early()),
            }
        }
    }

    /// The last line that it has said so far.
    pub fn latest(&mut self) -> Option<L> {
        self.lines.try_iter().filter_map(std::result::Result::ok).last()
    }

    /// Writes a line to its standard input.
    pub fn say(&mut self, line: &str) -> Result {
        let input = self.child.stdin.as_mut().ok_or("the input of the child is a pipe")?;
        writeln!(input, "{line}").map_err(|_| self.ended_early())
    }

    /// Writes a line to its standard input, and closes it.
    pub fn tell(&mut self, line: &str) -> Result {
        self.say(line)?;
        drop(self.child.stdin.take());
        Ok(())
    }

    /// Closes its standard input and waits for the end, which must be a success.
    pub fn finish(&mut self) -> Result {
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

    /// Says whether it still runs.
    pub fn still_runs(&mut self) -> Result {
        match self.child.try_wait()? {
            None => Ok(()),
            Some(_) => Err(self.ended_early()),
        }
    }

    fn ended_early(&mut self) -> Error {
        let words = self.last_words();
        format!("the {} ended early: {words}", self.name).into()
    }

    /// Asks it to end, as a terminal does, and kills it if it does not within five seconds.
    pub fn terminate(&mut self) {
        let patience = Duration::from_secs(5);
        self.ask_to_end();
        let since = Instant::now();
        while since.elapsed() < patience && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(Duration::from_millis(5));
        }
        end(&mut self.child);
    }

    /// Asks it to end, as a terminal does, and does not wait.
    pub fn ask_to_end(&mut self) {
        if let (Ok(None), Some(pid)) = (self.child.try_wait(), Pid::from_raw(self.child.id().cast_signed())) {
            // Ignored: it has ended meanwhile; its number is its own until it was waited for.
            let _ = kill_process(pid, Signal::TERM);
        }
    }

    /// Kills it and does not wait.
    pub fn kill(&mut self) {
        // Ignored: it has ended.
        let _ = self.child.kill();
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Ends the process and returns what it wrote to standard error in the end.
    pub(crate) fn last_words(&mut self) -> String {
        if !end(&mut self.child) {
            return "it was killed, and does not end".to_owned();
        }
        let words = self.errors.take().and_then(|errors| errors.join().ok()).unwrap_or_default();
        match String::from_utf8_lossy(&words).trim() {
            "" => "no error stated".to_owned(),
            words => format!("stderr: {words}"),
        }
    }
}

/// What is kept of standard error.
const WORDS: usize = 4096;

/// Reads to the end and returns the last [`WORDS`] bytes.
fn last_bytes(mut input: impl Read) -> Vec<u8> {
    let (mut last, mut buffer) = (Vec::new(), [0; WORDS]);
    loop {
        match input.read(&mut buffer) {
            Ok(0) => return last,
            Ok(bytes) => {
                last.extend_from_slice(&buffer[..bytes]);
                last.drain(..last.len().saturating_sub(WORDS));
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(_) => return last,
        }
    }
}

/// Kills it and waits for its end, which may have to wait for a thread of another process that never sleeps: says whether it came.
fn end(child: &mut Child) -> bool {
    // Ignored: it has ended.
    let _ = child.kill();
    let since = Instant::now();
    while matches!(child.try_wait(), Ok(None)) {
        if since.elapsed() > DYING {
            return false;
        }
        thread::sleep(Duration::from_millis(1));
    }
    true
}

impl<L> Drop for Process<'_, L> {
    fn drop(&mut self) {
        end(&mut self.child);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    fn shell(script: &str) -> Process<'static, u32> {
        static NEVER: AtomicBool = AtomicBool::new(false);
        Process::start(Command::new("sh").args(["-c", script]), "shell", &NEVER).unwrap()
    }

    #[test]
    fn a_process_that_complains_at_length_goes_on_and_its_last_words_are_kept() {
        // More than a pipe has room for.
        let mut shell =
            shell("head -c 200000 /dev/zero | tr '\\0' x >&2; echo the end >&2; echo 7; read line; exit 3");
        assert_eq!(shell.expect(PATIENCE, Some).unwrap(), 7);
        let error = shell.finish().unwrap_err().to_string();
        assert!(error.contains("stderr: xxx") && error.ends_with("the end"), "{error}");
        assert!(error.len() < WORDS + 100);
    }

    #[test]
    fn one_that_has_ended_is_told_from_one_that_runs() {
        let mut shell = shell("echo 1; read line; echo why >&2; echo 2");
        shell.expect(PATIENCE, Some).unwrap();
        shell.still_runs().unwrap();
        shell.tell("go").unwrap();
        assert!(shell.finish().is_ok());
        assert!(shell.still_runs().unwrap_err().to_string().contains("why"));
    }

    #[test]
    fn what_is_no_json_is_passed_over_unless_it_looks_like_it() {
        let mut shell = shell("echo hello; echo 7; echo '{broken'; read line");
        assert_eq!(shell.expect(PATIENCE, Some).unwrap(), 7);
        let error = shell.expect(PATIENCE, Some).unwrap_err().to_string();
        assert!(error.contains("{broken"), "{error}");
    }
}
