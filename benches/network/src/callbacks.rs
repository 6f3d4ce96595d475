// SPDX-License-Identifier: MIT OR Apache-2.0
//! Local real-time callbacks, with and without a flood that arrives from another host for another topic.
//!
//! The callbacks are those of `taut demo`: five topics that load one core to 90 %. The gateway of their host is as it comes:
//! its priority above theirs, its budget, any core. What is the other host here, and the flood's subscription, runs without
//! priority, on the other core where it can.

use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use serde_json::Value;
use tautline_benches::rows::{Round, Row, Tally, extent};
use tautline_benches::{Process, progress_bar};
use tautline_exchange::{Exchange, Job, Line, Measured, Role, Way};

use crate::Result;
use crate::plan::{FLOOD, Plan, QUIET, System};
use crate::report::Flood;
use crate::rounds::{DOMAINS, gateways, start};

/// 500 MB a second.
const MESSAGE_BYTES: usize = 1 << 20;
const RATE: f64 = 500e6 / MESSAGE_BYTES as f64;
const PATIENCE: Duration = Duration::from_secs(60);

/// Measures both, in turn.
pub fn run(plan: &Plan, interrupted: &AtomicBool) -> Result<(Vec<Row>, Flood)> {
    let (rounds, seconds) = plan.callbacks;
    let progress = progress_bar(u64::from(rounds) * 2);
    let (mut quiet, mut flooded, mut floods) = (Vec::new(), Vec::new(), Vec::new());
    for round in 1..=rounds {
        // To and fro, so that a drift of the machine meets both.
        for with_flood in if round % 2 == 1 { [false, true] } else { [true, false] } {
            let what = if with_flood { "a flood" } else { "no flood" };
            progress.set_message(format!("round {round}: callbacks and {what}"));
            let cores = [Some(plan.both[0]), None];
            let mut gateways = gateways(plan, cores, [false, plan.realtime], interrupted)?;
            if with_flood {
                let mut flood = Stream::start(plan, seconds, interrupted)?;
                flooded.push(demo(plan, seconds, interrupted)?);
                let throttled = gateways.stats(1)["throttled"].as_u64().unwrap_or(0);
                floods.push((flood.end()?, throttled));
            } else {
                quiet.push(demo(plan, seconds, interrupted)?);
            }
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    let [_, arrived_mb_per_s, _] = extent(floods.iter().map(|(measured, _)| mb_per_s(measured)).collect());
    let mut rows = rows(QUIET, 0, None, &quiet);
    rows.extend(self::rows(FLOOD, MESSAGE_BYTES, Some(arrived_mb_per_s), &flooded));
    let flood = Flood {
        offered_mb_per_s: RATE * MESSAGE_BYTES as f64 / 1e6,
        arrived_mb_per_s,
        throttled: floods.iter().map(|(_, throttled)| *throttled).max().unwrap_or(0),
    };
    Ok((rows, flood))
}

fn mb_per_s(measured: &Measured) -> f64 {
    measured.times_ns.len() as f64 * MESSAGE_BYTES as f64 / measured.seconds.max(1e-9) / 1e6
}

/// From one host to the other, whatever becomes of it.
struct Stream<'a> {
    near: Process<'a, Line>,
    far: Process<'a, Line>,
}

impl<'a> Stream<'a> {
    fn start(plan: &Plan, seconds: u64, interrupted: &'a AtomicBool) -> Result<Self> {
        let job = |role, host: usize, core| Job {
            role,
            exchange: Exchange::Paced { rate: RATE },
            payload_bytes: MESSAGE_BYTES,
            budget: Duration::from_secs(seconds),
            core,
            realtime: false,
            domain: DOMAINS[host],
            topic: format!("/bench/run_{}/flood", std::process::id()),
            endpoint: None,
            way: Way::default(),
        };
        let mut far = start(plan, System::Tautline, &job(Role::Far, 1, None), interrupted)?;
        far.expect(PATIENCE, Line::ready)?;
        let near = start(plan, System::Tautline, &job(Role::Near, 0, Some(plan.both[0])), interrupted)?;
        Ok(Stream { near, far })
    }

    fn end(&mut self) -> Result<Measured> {
        let measured = self.far.expect(PATIENCE, Line::measured)?;
        self.near.finish()?;
        self.far.finish()?;
        Ok(measured)
    }
}

/// The demo's report.
fn demo(plan: &Plan, seconds: u64, interrupted: &AtomicBool) -> Result<Value> {
    let scratch = tempfile::tempdir()?;
    let json = scratch.path().join("demo.json");
    let mut command = Command::new(&plan.taut);
    command.args(["demo", "--seconds", &seconds.to_string(), "--core", &plan.both[1].to_string()]);
    command.arg("--json").arg(&json).arg("--svg").arg(scratch.path().join("demo.svg"));
    if !plan.realtime {
        command.arg("--no-rt");
    }
    command.env("TAUT_DOMAIN", DOMAINS[1].to_string());
    Process::<Value>::start(&mut command, "demo", interrupted)?.finish()?;
    Ok(serde_json::from_str(&std::fs::read_to_string(json)?)?)
}

/// A row for each topic.
fn rows(experiment: &str, payload_bytes: usize, mb_per_s: Option<f64>, reports: &[Value]) -> Vec<Row> {
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
            mb_per_s,
            rounds: (1..).zip(topics()).map(round).collect(),
            ..Tally::default().row(experiment, System::Tautline.name(), name, payload_bytes)
        }
    };
    (0..topics).map(row).collect()
}
