// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether `taut topic hz` prints true rates: beside what the publisher itself says that it has sent.

use crate::{Result, Taut};
use serde_json::Value;
use std::sync::atomic::{AtomicBool, Ordering};
use tautline_harness::Beside;
use tautline_harness::readings::Reading;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{Limits, Participant, Qos, RawPublisher, TopicType};

/// A publisher that is farther from its rate has another one in each moment.
const TOLERANCE: f64 = 0.01;

/// Wanted rate, bytes of a message, and how long `hz` looks, in s.
const FLOWS: [(f64, usize, u64); 4] = [(1.0, 64, 5), (1000.0, 64, 2), (50_000.0, 64, 2), (30.0, 8 << 20, 2)];

/// Sends at absolute times until it is to stop; the rate that it has kept.
fn send(publisher: &RawPublisher, hz: f64, bytes: usize, stop: &AtomicBool) -> Result<f64> {
    let (body, start_ns) = (vec![0_u8; bytes], monotonic_ns());
    let mut sent = 0_u64;
    loop {
        sleep_until_monotonic(start_ns + (sent as f64 * 1e9 / hz) as u64);
        if stop.load(Ordering::Relaxed) {
            return Ok(sent as f64 * 1e9 / (monotonic_ns() - start_ns) as f64);
        }
        publisher.publish(&body)?;
        sent += 1;
    }
}

pub fn measure(taut: &Taut, quick: bool) -> Result<Vec<Reading>> {
    let participant = Participant::new(crate::DOMAIN)?;
    let mut readings = Vec::new();
    for (wanted_hz, bytes, seconds) in FLOWS {
        let limits = Limits { message_bytes: bytes.max(1024), ..Limits::default() };
        let topic_type = TopicType::new("bench_msgs/msg/Bytes");
        let publisher = participant.create_raw_publisher("/flow", &topic_type, Qos::keep_last(2), limits)?;
        let sender = Beside::start(move |stop| send(&publisher, wanted_hz, bytes, stop));
        let timeout = format!("{}s", if quick { seconds } else { 2 * seconds });
        let output = taut.command(&["topic", "hz", "/flow", "--json", "--timeout", &timeout]).output()?;
        let sent_hz = sender.end()?;
        let text = String::from_utf8(output.stdout)?;
        let report: Value = serde_json::from_str(text.lines().last().ok_or("hz prints nothing")?)?;
        let printed_hz = report["rate_hz"].as_f64().ok_or("hz prints no rate")?;
        let is_kept = (sent_hz / wanted_hz - 1.0).abs() < TOLERANCE;
        let what = "rate that is printed, to the one that was wanted";
        let one = Reading::of("rates", wanted_hz as usize, what, "x").value(printed_hz / wanted_hz);
        let one = one.at_least(0.99).at_most(1.01).must();
        let one = one.note(format!("{bytes} B, sent at {sent_hz:.3} Hz, printed {printed_hz:.3}"));
        readings.push(one.unfit((!is_kept).then_some("the publisher did not keep its rate")));
    }
    Ok(readings)
}
