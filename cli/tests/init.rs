// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut init --from-running`: what runs is in the file, which `taut check` takes.

mod support;

use futures::StreamExt;
use serde_json::{Value, json};
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use support::Here;
use tautline::Qos;
use tautline::example_interfaces::msg::UInt64;
use tautline::rt::clock::{monotonic_ns, sleep_until_monotonic};

const PERIOD: Duration = Duration::from_millis(20);

#[test]
fn what_runs_becomes_a_file() {
    let mut here = Here::new(41);
    let (mut driver, mut planner) = (here.node("driver", ""), here.node("planner", "/front"));
    let mut timer = driver.create_wall_timer(PERIOD).unwrap();
    let scans = driver.create_publisher::<UInt64>("/scan", Qos::default()).unwrap();
    let mut taken = planner.subscribe::<UInt64>("/scan", Qos::default()).unwrap();
    let paths = planner.create_publisher::<UInt64>("/path", Qos::default()).unwrap();
    let mut joystick = planner.subscribe::<UInt64>("/joystick", Qos::default()).unwrap();
    here.serve(&mut driver, async move {
        while timer.next().await.is_some() {
            scans.publish(&UInt64 { data: 1 }).unwrap();
        }
    });
    here.serve(&mut planner, async move {
        while taken.next().await.is_some() {
            // Uses no processor time.
            std::thread::sleep(Duration::from_millis(10));
            paths.publish(&UInt64 { data: 1 }).unwrap();
        }
    });
    here.serve(&mut planner, async move { while joystick.next().await.is_some() {} });
    // A thread that is no callback's.
    let (stop, mut source) = (Arc::new(AtomicBool::new(false)), here.node("source", ""));
    let commands = source.create_publisher::<UInt64>("/joystick", Qos::default()).unwrap();
    let is_stopped = stop.clone();
    let publishing = std::thread::spawn(move || {
        let start_ns = monotonic_ns();
        for n in (1..).take_while(|_| !is_stopped.load(Ordering::Relaxed)) {
            commands.publish(&UInt64 { data: n }).unwrap();
            sleep_until_monotonic(start_ns + n * 10_000_000);
        }
        commands
    });

    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("robot.toml");
    let path = file.to_str().unwrap();
    let template = folder.path().join("template.toml");
    let wrote = here.json(&["init", template.to_str().unwrap()]);
    assert_eq!(wrote, json!({ "file": template, "callbacks": null, "guesses": null }));
    let other = folder.path().join("json.toml");
    let wrote = here.json(&["init", "--from-running", "--seconds", "0.5", other.to_str().unwrap()]);
    assert!(wrote["callbacks"] == 3 && wrote["guesses"].as_u64() > Some(0), "{wrote}");
    let said = here.taut(&["init", "--from-running", "--seconds", "1", path]);
    assert!(said.contains("3 callbacks") && said.contains(&format!("taut check {path}")), "{said}");
    let text = std::fs::read_to_string(&file).unwrap();
    for part in [
        "[nodes.driver]",
        "[nodes.\"/front/planner\"]",
        "node = \"/front/planner\"",
        "period = \"20ms\"",
        "topic = \"/scan\"",
        "publishes = [\"/scan\"]",
        "publishes = [\"/path\"]",
        "# guess: the longest processor time of ",
        "[topics.\"/joystick\"]",
    ] {
        assert!(text.contains(part), "no {part} in:\n{text}");
    }
    // What `taut check` reads is what ran: the reader of /scan has the period of its publisher.
    let (_, checked, errors) = here.refused(&["check", path, "--json"]);
    let checked: Value =
        serde_json::from_str(&checked).unwrap_or_else(|error| panic!("{error}: {errors}\n{text}"));
    let callbacks = checked["callbacks"].as_array().unwrap();
    let periods: Vec<f64> =
        callbacks.iter().map(|callback| callback["period_ms"].as_f64().unwrap()).collect();
    assert_eq!(periods.iter().filter(|period| **period == 20.0).count(), 2, "{checked}");
    assert!(periods.iter().any(|period| (9.0..11.0).contains(period)), "{checked}");
    assert!(callbacks.iter().all(|callback| callback["wcet_ms"].as_f64().unwrap() < 10.0), "{checked}");

    let (code, _, words) = here.refused(&["init", "--from-running", path]);
    assert!(code == 1 && words.contains("exists and is left as it is"), "{words}");
    stop.store(true, Ordering::Relaxed);
    drop(publishing.join().unwrap());
    let (code, _, words) =
        here.refused(&["init", "--from-running", "--seconds", "0.1", "--domain", "42", "other.toml"]);
    assert!(code == 1 && words.contains("no callback ran while the domain was observed"), "{words}");
}

#[test]
fn no_option_is_ignored() {
    let here = Here::new(92);
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (trace, file) = (path("run.trace"), path("robot.toml"));
    // The shorter time ends them.
    here.taut(&["trace", "record", "--seconds", "1h", "--timeout", "10ms", "--out", &trace]);
    let (code, _, words) =
        here.refused(&["init", "--from-running", "--seconds", "1h", "--timeout", "10ms", &file]);
    assert!(code == 1 && words.contains("observing domain 92 for 10ms"), "{words}");

    let (code, _, words) = here.refused(&["init", "--from-trace", &trace, &file]);
    assert!(code == 1 && words.contains("run.trace, so there is nothing to describe: record"), "{words}");
    let (code, _, words) = here.refused(&["init", "--from-trace", &trace, "--domain", "7", &file]);
    assert!(code == 2 && words.contains("a recording contains its domain"), "{words}");
    let (code, _, words) = here.refused(&["init", &path("none/robot.toml")]);
    assert!(code == 2 && words.contains("cannot be written"), "{words}");
}

#[test]
fn a_path_may_have_any_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join(OsStr::from_bytes(b"r\xff.toml"));
    let output =
        Command::new(env!("CARGO_BIN_EXE_taut")).args(["init", "--json"]).arg(&file).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    assert!(file.exists());
}
