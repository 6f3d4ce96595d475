// SPDX-License-Identifier: MIT OR Apache-2.0
//! The program `taut-gateway`: what it says while it waits, and how it ends.

mod support;

use rustix::process::{Pid, Signal, kill_process};
use std::fs::OpenOptions;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use support::wait;
use tautline_gateway::Instance;

/// Whoever runs the tests may have set them.
const VARIABLES: [&str; 4] =
    ["ZENOH_SESSION_CONFIG_URI", "ZENOH_ROUTER_CONFIG_URI", "ZENOH_CONFIG_OVERRIDE", "RUST_LOG"];

fn gateway(domain: u32, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut-gateway"));
    command.args(["--no-rt", "--domain", &domain.to_string()]).args(args).env("TAUT_SCOPE", support::scope());
    for variable in VARIABLES {
        command.env_remove(variable);
    }
    command.stdout(Stdio::null()).stderr(Stdio::piped());
    command
}

/// Killed, if a test has failed.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_client_without_its_router_says_so_and_ends_when_asked() {
    const DOMAIN: u32 = 137;
    let mut command = gateway(DOMAIN, &["--client", "--connect", "tcp/127.0.0.1:1"]);
    let mut running = Running(command.spawn().unwrap());
    let mut lines = BufReader::new(running.0.stderr.take().unwrap()).lines().map_while(Result::ok);
    assert!(lines.any(|line| line == "waiting for tcp/127.0.0.1:1 ..."));
    kill_process(Pid::from_child(&running.0), Signal::TERM).unwrap();
    assert_eq!(wait("its end", || running.0.try_wait().unwrap()).code(), Some(0));
    let lock = format!("/dev/shm/{}/gateway", tautline_rt::domain::shared_folder(DOMAIN));
    assert!(!Path::new(&lock).exists(), "it leaves nothing");
}

#[test]
fn it_goes_on_when_its_numbers_cannot_be_written() {
    const DOMAIN: u32 = 140;
    const FULL: &str = "No space left on device";
    let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut command = gateway(DOMAIN, &["--connect", "tcp/127.0.0.1:1", "--json", "--interval", "0.1"]);
    let mut running = Running(command.stdout(full).spawn().unwrap());
    let mut lines = BufReader::new(running.0.stderr.take().unwrap()).lines().map_while(Result::ok);
    assert!(lines.any(|line| line.contains(FULL)));
    assert!(Instance::gateway(DOMAIN).lock().is_err(), "it has ended");
    kill_process(Pid::from_child(&running.0), Signal::TERM).unwrap();
    assert!(!lines.any(|line| line.contains(FULL)), "it is said once");
    assert_eq!(wait("its end", || running.0.try_wait().unwrap()).code(), Some(0));
}

#[test]
fn what_cannot_run_ends_with_2() {
    for (args, said) in [
        (["--config", "/no/such.json5"], "/no/such.json5"),
        (["--cores", "5000"], "core numbers from 0 to 1023"),
        (["--listen", "tcp"], "--listen"),
        (["--interval", "0"], "from 0.1 to 3600 seconds"),
    ] {
        let output = gateway(138, &args).output().unwrap();
        let words = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && words.contains(said), "{args:?}: {words}");
    }
}
