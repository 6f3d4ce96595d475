// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the tests share: bridges and gateways in processes of their own, rclpy in others, and patience.
#![allow(dead_code, reason = "no test uses all of it")]

pub mod gateway;
pub mod node;
pub mod peer;

pub use peer::*;

use node::Spinning;
use serde_json::Value;
use std::io::Read;
use std::ops::{Deref, DerefMut};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tautline_transport::Participant;

/// A bridge of a domain and that of ROS with the same number, with a participant in one and a node of rclpy in the other; `None`
/// without a ROS 2.
pub fn joined(domain: u32, peer: &str) -> Option<(BridgeProcess, Participant, Peer)> {
    let venv = ros()?;
    let bridge = BridgeProcess::start(domain, domain, &[]);
    Some((bridge, Participant::new(domain).unwrap(), Peer::start(&venv, domain, peer)))
}

/// The same with nodes that have services, `here` and `there`.
pub fn joined_nodes(domain: u32) -> Option<(BridgeProcess, Spinning, Peer)> {
    let venv = ros()?;
    let (bridge, here) = (BridgeProcess::start(domain, domain, &[]), Spinning::new(domain, "here"));
    Some((bridge, here, Peer::start_with_services(&venv, domain, "there")))
}

/// After this a restarted bridge or node is expected to be heard.
const RECOVERY: Duration = Duration::from_secs(5);

/// Has something die and come back, up to three times, until it took less than [`RECOVERY`]: what takes longer each time is not
/// the machine. Required where CI is set: elsewhere the machine may be busy.
pub fn recovers(what: &str, mut die_and_come_back: impl FnMut()) {
    let mut times = Vec::new();
    while times.len() < 3 {
        let since = Instant::now();
        die_and_come_back();
        times.push(since.elapsed());
        println!("{what}: {:?}", since.elapsed());
        if times.last() < Some(&RECOVERY) {
            return;
        }
    }
    assert!(std::env::var_os("CI").is_none(), "{what}: {times:?}");
}

/// `taut-bridge-ros`.
pub struct BridgeProcess(Program);

impl DerefMut for BridgeProcess {
    fn deref_mut(&mut self) -> &mut Program {
        &mut self.0
    }
}

impl Deref for BridgeProcess {
    type Target = Program;

    fn deref(&self) -> &Program {
        &self.0
    }
}

impl BridgeProcess {
    /// Without real-time priorities.
    pub fn start(domain: u32, ros_domain: u32, arguments: &[&str]) -> Self {
        Self::start_with(domain, ros_domain, arguments, |command| {
            command.arg("--no-rt");
        })
    }

    pub fn start_with(
        domain: u32,
        ros_domain: u32,
        arguments: &[&str],
        change: impl FnOnce(&mut Command),
    ) -> Self {
        BridgeProcess(Program::start("bridge", Self::command(domain, ros_domain, arguments, change)))
    }

    /// One that takes over when the one that runs ends.
    pub fn stand_by(domain: u32, ros_domain: u32) -> Self {
        let command = Self::command(domain, ros_domain, &["--standby", "--no-rt"], |_| {});
        BridgeProcess(Program::spawn("bridge on standby", command))
    }

    pub fn command(
        domain: u32,
        ros_domain: u32,
        arguments: &[&str],
        change: impl FnOnce(&mut Command),
    ) -> Command {
        [domain, ros_domain].into_iter().for_each(reserve);
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut-bridge-ros"));
        command.args(["--domain", &domain.to_string(), "--ros-domain", &ros_domain.to_string()]);
        command.env("TAUT_SCOPE", scope());
        command.args(["--json", "--interval", "0.1"]).args(arguments);
        // What may be said on the terminal that runs the tests is no concern of theirs.
        command.env_remove("RUST_LOG").env_remove("ROS_DOMAIN_ID").env_remove("TAUT_DOMAIN");
        change(&mut command);
        command
    }

    /// The numbers of a service.
    pub fn service(&self, service: &str) -> Value {
        let services = self.stats()["services"].as_array().cloned().unwrap_or_default();
        services.into_iter().find(|numbers| numbers["service"] == service).unwrap_or_default()
    }

    /// `kill -9`.
    pub fn kill(self) {
        self.0.kill();
    }
}

/// What a bridge that cannot run says, and whether it failed.
pub fn failure_of(arguments: &[&str], change: impl FnOnce(&mut Command)) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut-bridge-ros"));
    command.args(arguments).env_remove("RUST_LOG").env_remove("ROS_DOMAIN_ID").env("TAUT_SCOPE", scope());
    change(&mut command);
    failure(command)
}

/// What a program says that fails.
pub fn failure(mut command: Command) -> String {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut said = String::new();
    let end = Instant::now() + PATIENCE;
    while child.try_wait().unwrap().is_none() {
        if Instant::now() > end {
            let _ = child.kill();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(2), "it runs, or ends otherwise: {said}");
    said
}
