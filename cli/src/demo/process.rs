// SPDX-License-Identifier: MIT OR Apache-2.0
//! A child process of the demo, from the view of the process that started it.

use super::args::{DemoArgs, Role};
use super::protocol::{self, Line, Measured};
use crate::verb::{Failure, Outcome};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;
use tautline_rt::clock;
use tautline_rt::host::with_former_open_files;

/// The time limit for a process to set up, and to end.
const PATIENCE: Duration = Duration::from_secs(20);
/// The interval at which the child processes are checked.
pub const GLANCE: Duration = Duration::from_millis(100);

/// A child process; dropping it ends it.
pub struct Process {
    role: &'static str,
    child: Child,
    pub lines: Receiver<Line>,
}

impl Process {
    pub fn start(role: Role, args: &DemoArgs) -> Outcome<Self> {
        let role = role.name();
        let failed = |what: String| failed(role, &what);
        let executable =
            std::env::current_exe().map_err(|error| failed(format!("has no executable: {error}")))?;
        let mut command = Command::new(executable);
        command.args(["demo", "--role", role]);
        command.args(["--seconds", &args.seconds.to_string(), "--namespace", &args.namespace]);
        if let Some(priority) = args.sampler_priority {
            command.args(["--sampler-priority", &priority.to_string()]);
        }
        if let Some(core) = args.core {
            command.args(["--core", &core.to_string()]);
        }
        if args.no_rt {
            command.arg("--no-rt");
        }
        let mut child = with_former_open_files(&mut command)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| failed(format!("cannot be started: {error}")))?;
        let output = child.stdout.take().ok_or_else(|| failed("has no output".into()))?;
        Ok(Process { role, child, lines: protocol::listen(output) })
    }

    pub fn wait_until_ready(&mut self) -> Outcome {
        match self.lines.recv_timeout(PATIENCE) {
            Ok(Line::Ready) => Ok(()),
            Ok(_) => Err(self.failed("spoke before it was ready".into())),
            Err(RecvTimeoutError::Disconnected) => Err(self.ended_early()),
            Err(RecvTimeoutError::Timeout) => {
                Err(self.failed(format!("was not ready after {} s", PATIENCE.as_secs())))
            }
        }
    }

    pub fn request_end(&mut self) {
        drop(self.child.stdin.take());
    }

    /// Ends the subscriber and returns its measurements.
    pub fn end(mut self) -> Outcome<Measured> {
        self.request_end();
        let give_up = clock::monotonic_ns() + PATIENCE.as_nanos() as u64;
        while clock::monotonic_ns() < give_up {
            match self.lines.recv_timeout(GLANCE) {
                Ok(Line::Measured(measured)) => return self.wait().map(|()| measured),
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(self.ended_early()),
            }
        }
        Err(self.failed(format!("did not end within {} s", PATIENCE.as_secs())))
    }

    pub fn wait(&mut self) -> Outcome {
        match self.child.wait() {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => Err(self.failed(format!("failed ({status})"))),
            Err(error) => Err(self.failed(format!("cannot be waited for: {error}"))),
        }
    }

    pub fn must_live(&mut self) -> Outcome {
        match self.child.try_wait() {
            Ok(Some(status)) => Err(self.failed(format!("ended early ({status})"))),
            _ => Ok(()),
        }
    }

    pub fn ended_early(&mut self) -> Failure {
        let status = self.child.wait().map_or_else(|error| error.to_string(), |status| status.to_string());
        self.failed(format!("ended early ({status})"))
    }

    fn failed(&self, what: String) -> Failure {
        failed(self.role, &what)
    }
}

fn failed(role: &str, what: &str) -> Failure {
    Failure::unusable(format!(
        "the {role} process {what}: it has said why, and says more with RUST_LOG=debug"
    ))
}

impl Drop for Process {
    fn drop(&mut self) {
        self.request_end();
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
