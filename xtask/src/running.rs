// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs that run beside this one, until they have said enough.

use crate::steps::announce;
use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// A program, and what it has said; dropping it ends it.
pub struct Running {
    child: Child,
    said: Arc<Mutex<String>>,
    readers: Vec<JoinHandle<()>>,
}

impl Running {
    /// Starts it. What it says on standard output is kept, and what on standard error if it is so told.
    pub fn start(command: &mut Command, with_errors: bool) -> Result<Running, String> {
        announce(command);
        command.stdin(Stdio::null()).stdout(Stdio::piped());
        if with_errors {
            command.stderr(Stdio::piped());
        }
        let mut child = command.spawn().map_err(|error| format!("cannot be started: {error}"))?;
        let said = Arc::<Mutex<String>>::default();
        let output = child.stdout.take().map(|output| reader(output, &said));
        let errors = child.stderr.take().map(|errors| reader(errors, &said));
        Ok(Running { child, said, readers: output.into_iter().chain(errors).collect() })
    }

    pub fn said(&self) -> String {
        self.said.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// How it ended, once it has and all that it said is kept.
    pub fn status(&mut self) -> Option<ExitStatus> {
        let status = self.child.try_wait().ok()??;
        self.readers.drain(..).for_each(|reader| drop(reader.join()));
        Some(status)
    }

    /// Waits until it has said enough, has ended or time is up; how it ended if it has.
    pub fn wait_until(&mut self, end: Instant, is_enough: impl Fn(&str) -> bool) -> Option<ExitStatus> {
        loop {
            let status = self.status();
            if status.is_some() || is_enough(&self.said()) || Instant::now() >= end {
                return status;
            }
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Ends it; all that it said is kept.
    pub fn end(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.readers.drain(..).for_each(|reader| drop(reader.join()));
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.end();
    }
}

/// Keeps what comes, line by line.
fn reader(output: impl Read + Send + 'static, said: &Arc<Mutex<String>>) -> JoinHandle<()> {
    let said = said.clone();
    thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            *said.lock().unwrap_or_else(PoisonError::into_inner) += &format!("{line}\n");
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_heard_until_it_has_said_enough_or_has_ended() {
        let end = Instant::now() + Duration::from_secs(60);
        let start = |script| Running::start(Command::new("sh").args(["-c", script]), true).unwrap();
        let mut endless = start("echo a >&2; exec sleep 1000");
        assert_eq!(endless.wait_until(end, |said| said.contains('a')), None);
        endless.end();
        let mut failing = start("echo b; exit 3");
        assert_eq!(failing.wait_until(end, |_| false).and_then(|status| status.code()), Some(3));
        assert_eq!((endless.said(), failing.said()), ("a\n".to_owned(), "b\n".to_owned()));
    }
}
