// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether `taut topic hz` prints true rates: beside what the publisher itself says that it has sent.

use crate::{Result, Taut};
use serde::Serialize;
use serde_json::Value;
use std::sync::atomic::{AtomicBool, Ordering};
use tautline_benches::table::Column::Number;
use tautline_benches::table::Table;
use tautline_benches::{Beside, cells};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{Limits, Participant, Qos, RawPublisher, TopicType};

/// How far a rate may be from the true one.
const TOLERANCE: f64 = 0.01;

/// Wanted rate, bytes of a message, and how long `hz` looks, in s.
const FLOWS: [(f64, usize, u64); 4] = [(1.0, 64, 5), (1000.0, 64, 2), (50_000.0, 64, 2), (30.0, 8 << 20, 2)];

#[derive(Serialize)]
pub struct Rate {
    wanted_hz: f64,
    bytes: usize,
    sent_hz: f64,
    printed_hz: f64,
}

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

/// Prints the rates, and adds what does not hold to `broken`.
pub fn measure(taut: &Taut, quick: bool, broken: &mut Vec<String>) -> Result<Vec<Rate>> {
    let participant = Participant::new(crate::DOMAIN)?;
    let mut rates = Vec::new();
    println!("\nrates: what the publisher has kept, and what taut topic hz prints\n");
    let mut table = Table::new(0, ["wanted Hz", "bytes", "sent Hz", "printed Hz", "is x"].map(Number));
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
        let [sent, printed] = [sent_hz, printed_hz].map(|hz| format!("{hz:.3}"));
        table.add(cells![wanted_hz, bytes, sent, printed, format!("{:.4}", printed_hz / sent_hz)]);
        // A publisher that could not keep its rate has another one in each moment.
        let is_kept = (sent_hz / wanted_hz - 1.0).abs() < TOLERANCE;
        if is_kept && (printed_hz / wanted_hz - 1.0).abs() > TOLERANCE {
            broken.push(format!("{wanted_hz} Hz of {bytes} B: hz prints {printed_hz}"));
        }
        rates.push(Rate { wanted_hz, bytes, sent_hz, printed_hz });
    }
    println!("{table}");
    Ok(rates)
}
