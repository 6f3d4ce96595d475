// SPDX-License-Identifier: MIT OR Apache-2.0
//! What tests of verbs that ask nodes share: such nodes in the test's process, and `taut` beside it.
#![allow(dead_code, reason = "no test uses all of it")]

pub mod schemas;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use schemas::{Checked, ended};
use serde_json::Value;
use std::ffi::OsString;
use std::future::Future;
use std::io::Read;
use std::os::fd::AsFd;
use std::pin::Pin;
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
use tautline::{CallbackHandle, CallbackOptions, Context, Node, Realtime};

pub type Served = Pin<Box<dyn Future<Output = ()> + Send>>;

/// A context that spins until this is dropped.
pub struct Here {
    pub context: Context,
    pub domain: u32,
    served: Vec<CallbackHandle>,
    thread: Option<JoinHandle<()>>,
}

impl Here {
    pub fn new(domain: u32) -> Self {
        let context = Context::builder().domain(domain).realtime(Realtime::Off).build().unwrap();
        let sampler = context.clone();
        let thread = std::thread::spawn(move || sampler.spin().unwrap());
        Here { context, domain, served: Vec::new(), thread: Some(thread) }
    }

    pub fn node(&self, name: &str, namespace: &str) -> Node {
        Node::create(self.context.clone(), name, namespace).unwrap()
    }

    /// Runs it on a thread of its own, as long as this is there.
    pub fn serve(&mut self, node: &mut Node, future: impl Future<Output = ()> + Send + 'static) {
        self.served.push(node.spawn_callback(CallbackOptions::other().stack_bytes(8 << 20), future).unwrap());
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        command.args(args).env("TAUT_DOMAIN", self.domain.to_string()).env_remove("RUST_LOG");
        command
    }

    /// What a command prints that succeeds.
    pub fn taut(&self, args: &[&str]) -> String {
        let output = self.command(args).checked();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{args:?}: {errors}");
        String::from_utf8(output.stdout).unwrap()
    }

    pub fn json(&self, args: &[&str]) -> Value {
        serde_json::from_str(&self.taut(&[args, &["--json"]].concat())).unwrap()
    }

    /// The exit code of one that does not, what it prints, and its words.
    pub fn refused(&self, args: &[&str]) -> (i32, String, String) {
        ended(self.command(args).checked())
    }

    /// A command that goes on.
    pub fn start(&self, args: &[&str]) -> Running {
        Running::start(&mut self.command(args))
    }
}

impl Drop for Here {
    fn drop(&mut self) {
        self.context.shutdown();
        if let Some(thread) = self.thread.take() {
            assert!(thread.join().is_ok() || std::thread::panicking());
        }
    }
}

/// A command that goes on; it is killed if it is not waited for.
pub struct Running(Option<Child>, Vec<OsString>);

impl Running {
    pub fn start(command: &mut Command) -> Self {
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        Running(Some(child), command.get_args().map(ToOwned::to_owned).collect())
    }

    fn child(&mut self) -> &mut Child {
        self.0.as_mut().expect("until its end")
    }

    /// The next line that it prints.
    pub fn line(&mut self) -> String {
        let line = next_line(self.child().stdout.as_mut().unwrap());
        schemas::check(self.1.iter().map(|word| &**word), line.as_bytes());
        line
    }

    /// The next line of its words.
    pub fn words(&mut self) -> String {
        next_line(self.child().stderr.as_mut().unwrap())
    }

    pub fn has_ended(&mut self) -> bool {
        self.child().try_wait().unwrap().is_some()
    }

    pub fn interrupt(&mut self) {
        let pid = self.child().id().to_string();
        assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    }

    /// As a terminal's Ctrl-C does: the process group is one that it leads.
    pub fn interrupt_group(&mut self) {
        let group = format!("-{}", self.child().id());
        assert!(Command::new("kill").args(["-INT", "--", &group]).status().unwrap().success());
    }

    pub fn end(mut self) -> (i32, String, String) {
        let output = self.0.take().expect("until its end").wait_with_output().unwrap();
        schemas::check(self.1.iter().map(|word| &**word), &output.stdout);
        ended(output)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Fails if it does not come.
fn next_line(mut from: impl Read + AsFd) -> String {
    let mut line = Vec::new();
    while line.last() != Some(&b'\n') {
        let patience = Timespec { tv_sec: 60, tv_nsec: 0 };
        let ready = poll(&mut [PollFd::new(&from, PollFlags::IN)], Some(&patience)).unwrap();
        assert!(ready > 0, "no line in a minute, after '{}'", String::from_utf8_lossy(&line));
        let mut byte = [0];
        if from.read(&mut byte).unwrap() == 0 {
            break;
        }
        line.extend(byte);
    }
    String::from_utf8(line).unwrap()
}

/// Whether a command ended with this code, and said this.
#[track_caller]
pub fn said(ended: &(i32, String, String), code: i32, words: &str) {
    assert!(ended.0 == code && ended.2.contains(words), "{ended:?}");
}
