// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut top`: of processes that come, are measured, and are killed; on a terminal.

mod support;

use futures::StreamExt;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::OFlags;
use rustix::pty;
use rustix::termios::{Winsize, tcsetwinsize};
use serde_json::Value;
use std::fs::File;
use std::io::{Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use support::Here;
use support::schemas::Checked;
use tautline::example_interfaces::msg::UInt64;
use tautline::{CallbackOptions, Qos};
use tautline_transport::{EndpointKind, graph_of};

const DOMAIN: u32 = 144;

fn taut(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.args(args).env("TAUT_DOMAIN", DOMAIN.to_string());
    command
}

fn picture() -> Value {
    let output = taut(&["top", "--once", "--json", "--every", "300ms"]).checked();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn publisher() -> Child {
    let child = taut(&["topic", "pub", "/tick", "std_msgs/msg/Header", "-r", "200"])
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let end = Instant::now() + Duration::from_secs(30);
    let is_there = || {
        let graph = graph_of(DOMAIN).unwrap();
        graph.endpoints.iter().any(|end| end.topic == "/tick" && end.kind == EndpointKind::Publisher)
    };
    while !is_there() {
        assert!(Instant::now() < end, "nobody publishes");
        std::thread::yield_now();
    }
    child
}

#[test]
fn what_runs_is_shown_until_it_dies() {
    let mut child = publisher();
    let shown = picture();
    let topic = shown["topics"].as_array().unwrap().iter().find(|topic| topic["name"] == "/tick").unwrap();
    assert_eq!((&topic["type"], &topic["publishers"]), (&"std_msgs/msg/Header".into(), &1.into()));
    assert!(topic["rate_hz"].as_f64() > Some(0.0) && topic["bytes_per_s"].as_f64() > Some(0.0), "{topic}");
    let cores = shown["cores"].as_array().unwrap();
    assert!(
        !cores.is_empty()
            && cores.iter().all(|core| (0.0..=100.0).contains(&core["load_percent"].as_f64().unwrap()))
    );
    let table = taut(&["top", "--once", "--filter", "tick", "--sort", "rate"]).output().unwrap();
    assert!(String::from_utf8(table.stdout).unwrap().contains("/tick"));
    child.kill().unwrap();
    child.wait().unwrap();
    assert_eq!(
        picture()["topics"],
        Value::Array(Vec::new()),
        "who was killed is not there, though nobody cleaned up after it"
    );

    let refused = taut(&["top"]).stdin(Stdio::null()).output().unwrap();
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8(refused.stderr).unwrap().contains("this is no terminal"));
}

/// As of two nodes of one kind in a process.
#[test]
fn callbacks_of_one_name_have_rates_of_their_own() {
    let here = Here::new(164);
    let mut node = here.node("twins", "");
    let mut twin = |topic: &str, messages: u64| {
        let publisher = node.create_publisher::<UInt64>(topic, Qos::keep_last(50)).unwrap();
        let taken = node.subscribe::<UInt64>(topic, Qos::keep_last(50)).unwrap();
        (0..messages).for_each(|data| publisher.publish(&UInt64 { data }).unwrap());
        let options = CallbackOptions::other().name("twin");
        let handle = node.spawn_callback(options, taken.for_each(|_| async {})).unwrap();
        while handle.stats().completions() < messages {
            std::thread::yield_now();
        }
        handle
    };
    let _twins = [twin("/busy", 50), twin("/idle", 0)];
    let shown = here.json(&["top", "--once", "--every", "300ms"]);
    let callbacks = shown["callbacks"].as_array().unwrap();
    let jobs: u64 = callbacks.iter().filter_map(|callback| callback["jobs"].as_u64()).sum();
    assert_eq!((callbacks.len(), jobs), (2, 50), "{shown}");
    for callback in callbacks {
        assert_eq!(callback["releases_hz"], 0.0, "neither has a job now: {shown}");
        assert!(callback["response_p50_ms"].is_null(), "{shown}");
    }
}

/// Reads what is drawn until the terminal is as wanted.
fn read_until(
    terminal: &mut File,
    screen: &mut vt100::Parser,
    what: &str,
    is_it: impl Fn(&vt100::Screen) -> bool,
) {
    let mut bytes = [0; 4096];
    let patience = Timespec { tv_sec: 30, tv_nsec: 0 };
    while !is_it(screen.screen()) {
        let seen = poll(&mut [PollFd::new(terminal, PollFlags::IN)], Some(&patience)).unwrap();
        assert!(seen > 0, "{what:?} does not come: {}", screen.screen().contents());
        let len = terminal.read(&mut bytes).unwrap();
        screen.process(&bytes[..len]);
    }
}

/// `taut top` in a terminal of its own, which is the second value, and what that shows.
fn on_terminal() -> (Child, File, vt100::Parser) {
    // The other side must not have this one: it would never hang up.
    let flags = pty::OpenptFlags::RDWR | pty::OpenptFlags::NOCTTY | pty::OpenptFlags::CLOEXEC;
    let terminal = pty::openpt(flags).unwrap();
    pty::grantpt(&terminal).unwrap();
    pty::unlockpt(&terminal).unwrap();
    let size = Winsize { ws_row: 24, ws_col: 120, ws_xpixel: 0, ws_ypixel: 0 };
    tcsetwinsize(&terminal, size).unwrap();
    let path = pty::ptsname(&terminal, Vec::new()).unwrap().into_string().unwrap();
    // Nor may it become this process's own, which would end with it.
    let flags = OFlags::NOCTTY.bits() as i32;
    let open = || File::options().read(true).write(true).custom_flags(flags).open(&path).unwrap();
    let mut top = taut(&["top", "--domain", "145", "--every", "100ms"]);
    let top = top.stdin(open()).stdout(open()).stderr(open()).spawn().unwrap();
    (top, File::from(terminal), vt100::Parser::new(24, 120, 0))
}

#[test]
fn on_a_terminal_it_goes_on_until_q() {
    let (mut top, mut terminal, mut screen) = on_terminal();
    // Each key once the one before has been answered.
    for (key, answer) in [
        ("", "taut top: domain 145, 0 processes"),
        ("/", "filter: _"),
        ("x", "filter: x_"),
        ("\r", "/ filter (x)"),
        ("s", "s sort (Rate)"),
        ("\t", "> 0 topics"),
        (" ", "0 processes, frozen"),
        (" ", "0 processes "),
    ] {
        terminal.write_all(key.as_bytes()).unwrap();
        read_until(&mut terminal, &mut screen, answer, |screen| screen.contents().contains(answer));
    }
    for (rows, columns) in [(40, 100), (8, 60)] {
        tcsetwinsize(&terminal, Winsize { ws_row: rows, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 })
            .unwrap();
        screen.screen_mut().set_size(rows, columns);
        let foot = |screen: &vt100::Screen| screen.rows(0, columns).last().unwrap_or_default();
        read_until(&mut terminal, &mut screen, "another size", |screen| foot(screen).starts_with("q quit"));
        assert!(screen.screen().contents().starts_with("taut top: domain 145"), "{rows} rows");
    }
    terminal.write_all(b"q").unwrap();
    read_until(&mut terminal, &mut screen, "the end", |screen| !screen.alternate_screen());
    assert!(top.wait().unwrap().success());
}

#[test]
fn it_ends_with_its_terminal() {
    let (mut top, mut terminal, mut screen) = on_terminal();
    let is_drawn = |screen: &vt100::Screen| screen.contents().contains("0 processes");
    read_until(&mut terminal, &mut screen, "the first picture", is_drawn);
    terminal.write_all(b" ").unwrap();
    let is_frozen = |screen: &vt100::Screen| screen.contents().contains("frozen");
    read_until(&mut terminal, &mut screen, "frozen: nothing is written", is_frozen);
    drop(terminal);
    assert_eq!(top.wait().unwrap().code(), Some(2));
}
