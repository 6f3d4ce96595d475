// SPDX-License-Identifier: MIT OR Apache-2.0
//! The program `taut-gateway`: what it says while it waits, and how it ends.

mod support;

use rustix::process::{Pid, Signal, kill_process};
use std::fs::OpenOptions;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, SystemTime};
use support::{UNKNOWN_HASH, string_type, until, wait};
use tautline_gateway::Instance;
use tautline_gateway::wire::{Attachment, Token, endpoint_gid};
use tautline_transport::{Limits, Participant, Qos};
use zenoh::Wait;
use zenoh::time::{NTP64, Timestamp};

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

/// Zenoh compares each sample's own time stamp with its clock.
#[test]
fn samples_of_a_host_whose_clock_is_ahead_fill_no_log() {
    const DOMAIN: u32 = 139;
    let mut command = gateway(DOMAIN, &["--connect", "tcp/127.0.0.1:1", "--listen", "tcp/127.0.0.1:0"]);
    let mut running = Running(command.spawn().unwrap());
    let mut lines = BufReader::new(running.0.stderr.take().unwrap()).lines().map_while(Result::ok);
    let address = |line: String| Some(line.strip_prefix("listening on ")?.split_once(": ")?.0.to_owned());
    let locator = lines.find_map(address).unwrap();
    let text = format!(
        r#"{{ mode: "client", connect: {{ endpoints: ["{locator}"] }}, scouting: {{ multicast: {{ enabled: false }} }} }}"#
    );
    let far = zenoh::open(zenoh::Config::from_json5(&text).unwrap()).wait().unwrap();
    let participant = Participant::new(DOMAIN).unwrap();
    let (qos, limits) = (Qos::keep_last(10), Limits::default());
    let subscription = participant.create_raw_subscription("/x", &string_type(), qos, limits).unwrap();
    let name = format!("std_msgs::msg::dds_::String_/{UNKNOWN_HASH}");
    let token = format!("@ros2_lv/{DOMAIN}/bad/0/1/MP/%/%/n/%x/{name}/::,10:,:,:,,");
    let gid = endpoint_gid(&Token::parse(&token).unwrap());
    let _token = far.liveliness().declare_token(token).wait().unwrap();
    let ahead = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap() + Duration::from_secs(3600);
    let stamp = Timestamp::new(NTP64::from(ahead), *far.new_timestamp().get_id());
    let source_timestamp_ns = i64::try_from(ahead.as_nanos()).unwrap();
    let attachment = Attachment { sequence_number: 1, source_timestamp_ns, gid }.encode();
    until("a sample", || {
        let put = far.put(format!("{DOMAIN}/x/{name}"), [0, 1, 0, 0, 7]).timestamp(stamp);
        put.attachment(&attachment[..]).wait().unwrap();
        subscription.try_take_valid().unwrap().is_some()
    });
    kill_process(Pid::from_child(&running.0), Signal::TERM).unwrap();
    let logged: Vec<String> = lines.filter(|line| line.contains("timestamp")).collect();
    assert!(logged.is_empty(), "{logged:?}");
    assert_eq!(wait("its end", || running.0.try_wait().unwrap()).code(), Some(0));
}
