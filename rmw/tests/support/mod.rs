// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the tests share: nodes of rclpy on rmw_tautline, in processes of their own.
#![allow(dead_code, reason = "no test uses all of it")]

#[path = "../../../bridge-ros/tests/support/gateway.rs"]
pub mod gateway;
#[path = "../../../bridge-ros/tests/support/peer.rs"]
mod peer;

pub use peer::*;

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;
use tautline_rt::permission::{realtime_permitted, test_needs};
use tautline_transport::Participant;

/// A domain of rclpy nodes. This process is in it to the end, for it cleans up after who was killed.
pub struct Domain {
    pub number: u32,
    pub venv: PathBuf,
    pub participant: Participant,
}

impl Domain {
    /// For this test alone; prints why it is skipped without rclpy.
    pub fn new(number: u32) -> Option<Self> {
        let venv = ros()?;
        reserve(number);
        Some(Domain { number, venv, participant: Participant::new(number).unwrap() })
    }

    /// A node of rclpy with services, actions and parameters.
    pub fn peer(&self, name: &str) -> Peer {
        Peer::start_as(&self.venv, self.number, name, "ros_services_peer.py", on_tautline)
    }

    /// One whose executor has one thread.
    pub fn simple_peer(&self, name: &str) -> Peer {
        Peer::start_as(&self.venv, self.number, name, "ros_peer.py", on_tautline)
    }

    /// The same with more in its environment.
    pub fn simple_peer_with(&self, name: &str, variables: &[(&str, &str)]) -> Peer {
        Peer::start_as(&self.venv, self.number, name, "ros_peer.py", |command| {
            on_tautline(command);
            command.envs(variables.iter().copied());
        })
    }

    /// A program of ROS's that runs in it on rmw_tautline.
    pub fn command(&self, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new(program);
        command.env_remove("LD_LIBRARY_PATH").env_remove("AMENT_PREFIX_PATH");
        command.env("ROS_DOMAIN_ID", self.number.to_string()).env("PYTHONDONTWRITEBYTECODE", "1");
        on_tautline(&mut command);
        command
    }

    /// One that is written here, with rclpy.
    pub fn python(&self, program: &str) -> Command {
        let mut command = self.command(self.venv.join("bin/python"));
        // What it prints in a line is one write, which no log line of another thread divides.
        command.args(["-c", program]).env_remove("PYTHONUNBUFFERED");
        command
    }

    /// Members of the domain besides this process.
    pub fn others(&self) -> usize {
        let folder = std::fs::read_dir(tautline_rt::domain::shared_path(self.number)).unwrap();
        let names = folder.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        names.filter(|name| name.starts_with('p')).count() - 1
    }
}

impl Drop for Domain {
    fn drop(&mut self) {
        // Peers end without a word.
        if !std::thread::panicking() {
            wait_until("all others to be cleaned up after", || self.others() == 0);
        }
    }
}

/// Whether a program succeeded, and what it said.
pub fn words_of(command: &mut Command) -> (bool, String, String) {
    let output = command.output().unwrap();
    let [out, errors] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    (output.status.success(), out, errors)
}

/// Whether threads may have the priorities of the tests' system files; prints why a test is skipped without.
pub fn may_be_realtime() -> bool {
    test_needs(realtime_permitted(50)).is_some()
}

/// Has a program of ROS's use rmw_tautline. Those of PyPI's packages are linked to Fast DDS's RMW, whose place it takes; with an
/// installed ROS 2 the variable is enough.
pub fn on_tautline(command: &mut Command) {
    command.env("LD_PRELOAD", library()).env("RMW_IMPLEMENTATION", "rmw_tautline").env("TAUT_SCOPE", scope());
}

/// Cargo builds it beside the tests.
fn library() -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    let library = tests.ancestors().nth(2).map(Path::to_owned).unwrap().join("librmw_tautline.so");
    assert!(library.is_file(), "no {}: cargo xtask rmw", library.display());
    library
}
