// SPDX-License-Identifier: MIT OR Apache-2.0
//! Local real-time callbacks, with and without a flood that arrives from another host for another topic.
//!
//! The callbacks are those of `taut demo`: five topics that load one core to 90 %. The gateway of their host is as it comes: its
//! priority is above theirs, it has a budget, and runs on any core. The other host and the subscription to the flood run without
//! priorities, on the other core where they can.

use std::process::Command;
use std::time::Duration;

use serde_json::Value;
use tautline_exchange::{Job, Line, Role};
use tautline_harness::rows::{Round, Row, Tally, extent};
use tautline_harness::{Process, progress_bar};

use crate::Result;
use crate::modes::{GATEWAY, MODES, Mode, TAUT};
use crate::pair::{FAR_DOMAIN, PATIENCE, Setup};
use crate::plan::{Case, Idle, Task};
use crate::report::missing;

/// Without and with a flood.
pub const QUIET: &str = "callbacks/quiet";
pub const FLOOD: &str = "callbacks/flood";
/// The demo's, which take the place of modes.
pub const TOPICS: [&str; 5] = ["topic1", "topic2", "topic3", "topic4", "topic5"];

/// 500 MB a second.
pub const MESSAGE_BYTES: usize = 1 << 20;
const RATE: f64 = 500e6 / MESSAGE_BYTES as f64;

/// Measures both, in turn: a row for each topic of the demo.
pub fn run(setup: &Setup<'_>) -> Result<Vec<Row>> {
    let (rounds, seconds) = setup.plan.callbacks;
    if rounds == 0 {
        return Ok(Vec::new());
    }
    let programs = &setup.plan.programs;
    if let Err(reason) = programs.find(GATEWAY).and_then(|_| programs.find(TAUT)) {
        return Ok(vec![missing("tautline", "callbacks", &reason)]);
    }
    let progress = progress_bar(u64::from(rounds) * 2);
    let (mut quiet, mut flooded, mut arrived, mut throttled) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for round in 1..=rounds {
        // To and fro, so that a drift of the machine meets both.
        for with_flood in if round % 2 == 1 { [false, true] } else { [true, false] } {
            let what = if with_flood { "a flood" } else { "no flood" };
            progress.set_message(format!("round {round}: callbacks and {what}"));
            let mut gateways =
                setup.gateways([Some(setup.plan.cores[0]), None], [false, setup.plan.realtime])?;
            if with_flood {
                let flood = Flood::start(setup, seconds, round)?;
                flooded.push(demo(setup, seconds)?);
                throttled = throttled.max(gateways.throttled(1));
                arrived.push(flood.end()?);
            } else {
                quiet.push(demo(setup, seconds)?);
            }
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    let [_, mb_per_s, _] = extent(arrived);
    let sent = RATE * MESSAGE_BYTES as f64 / 1e6;
    let flood = |row| Row {
        payload_bytes: MESSAGE_BYTES,
        mb_per_s: Some(mb_per_s),
        throttled: Some(throttled),
        note: format!("flood: {sent:.0} MB/s sent, {mb_per_s:.0} MB/s arrived (median round)"),
        ..row
    };
    let of_flood = rows(FLOOD, &flooded).into_iter().map(flood);
    Ok(rows(QUIET, &quiet).into_iter().chain(of_flood).collect())
}

/// From one host to the other, whatever becomes of it.
struct Flood<'a> {
    near: Process<'a, Line>,
    far: Process<'a, Line>,
}

impl<'a> Flood<'a> {
    fn start(setup: &'a Setup<'_>, seconds: u64, round: u32) -> Result<Self> {
        let is_gateway = |mode: &&Mode| mode.system == "tautline" && mode.mode == GATEWAY;
        let case = Case {
            experiment: FLOOD.to_owned(),
            task: Task::Paced {
                rate: RATE,
                topics: 1,
                processes: 1,
                subscribers: 1,
                is_loaded: false,
                at_once: false,
            },
            mode: MODES.iter().find(is_gateway).ok_or("there is no way over gateways")?,
            payload_bytes: MESSAGE_BYTES,
            idle: Idle::AsShipped,
            // Longer than the demo takes to start and to run.
            budget: Duration::from_secs(seconds + 5),
            rounds: 1,
        };
        let topic = format!("/compare/run_{}/flood_{round}", std::process::id());
        let job = |role| {
            let mut job = Job { realtime: false, ..setup.job(&case, role, &topic) };
            // Filling and reading it would be a load of its own.
            job.way.whole = false;
            job
        };
        let mut far = setup.start(&case, &Job { core: None, ..job(Role::Far) }, "")?;
        far.expect(PATIENCE, Line::ready)?;
        let mut near = setup.start(&case, &job(Role::Near), "")?;
        far.expect(PATIENCE, |line| matches!(line, Line::Connected { .. }).then_some(()))?;
        near.tell("go")?;
        Ok(Flood { near, far })
    }

    /// Ends it; returns how many MB arrived in a second.
    fn end(mut self) -> Result<f64> {
        self.far.tell("stop")?;
        let received = self.far.expect(PATIENCE, Line::measured)?;
        self.far.finish()?;
        self.near.kill();
        Ok(received.messages as f64 * MESSAGE_BYTES as f64 / received.seconds.max(1e-9) / 1e6)
    }
}

/// The demo's report.
fn demo(setup: &Setup<'_>, seconds: u64) -> Result<Value> {
    let file = |name: &str| setup.scratch.directory().join(name);
    let json = file("demo.json");
    let mut command = Command::new(setup.plan.programs.find(TAUT)?);
    command.args(["demo", "--seconds", &seconds.to_string(), "--core", &setup.plan.cores[1].to_string()]);
    command.arg("--json").arg(&json).arg("--svg").arg(file("demo.svg"));
    if !setup.plan.realtime {
        command.arg("--no-rt");
    }
    command.env("TAUT_DOMAIN", FAR_DOMAIN.to_string());
    Process::<Value>::start(&mut command, "demo", setup.interrupted)?.finish()?;
    Ok(serde_json::from_str(&std::fs::read_to_string(json)?)?)
}

/// A row for each topic.
fn rows(experiment: &str, reports: &[Value]) -> Vec<Row> {
    let topics = reports.first().and_then(|report| report["topics"].as_array()).map_or(0, Vec::len);
    let row = |index: usize| {
        let topics = || reports.iter().map(|report| &report["topics"][index]);
        let us = |topic: &Value, key: &str| topic[key].as_f64().unwrap_or(0.0) * 1e3;
        let of_rounds = |key: &str| extent(topics().map(|topic| us(topic, key)).collect());
        let count = |topic: &Value, key: &str| topic[key].as_u64().unwrap_or(0);
        let ([_, p50_us, _], [_, p99_us, _]) = (of_rounds("p50_ms"), of_rounds("p99_ms"));
        let [.., max_us] = of_rounds("max_ms");
        let name = reports[0]["topics"][index]["topic"].as_str().unwrap_or("?");
        let round = |(round, topic): (u32, &Value)| Round {
            round,
            n: count(topic, "n"),
            p50_us: us(topic, "p50_ms"),
            p99_us: us(topic, "p99_ms"),
            // A round has less than a thousand.
            p999_us: us(topic, "max_ms"),
            ..Round::default()
        };
        Row {
            n: topics().map(|topic| count(topic, "n")).sum(),
            p50_us: Some(p50_us),
            p99_us: Some(p99_us),
            p999_us: Some(max_us),
            max_us: Some(max_us),
            lost: topics().map(|topic| count(topic, "lost")).sum(),
            rounds: (1..).zip(topics()).map(round).collect(),
            ..Tally::default().row(experiment, "tautline", name, 0)
        }
    };
    (0..topics).map(row).collect()
}
