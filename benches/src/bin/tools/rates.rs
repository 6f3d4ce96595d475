// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether `taut topic hz` prints true rates: beside what the publisher itself says that it has sent.

use crate::{Result, Taut};
use serde::Serialize;
use serde_json::Value;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
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

/// Prints the rates; the second value is what does not hold.
pub fn measure(taut: &Taut, quick: bool) -> Result<(Vec<Rate>, Vec<String>)> {
    let participant = Participant::new(crate::DOMAIN)?;
    let mut rates = Vec::new();
    println!("\nrates: what the publisher has kept, and what taut topic hz prints\n");
    println!("{:>10}  {:>9}  {:>11}  {:>11}  {:>8}", "wanted Hz", "bytes", "sent Hz", "printed Hz", "is x");
    for (wanted_hz, bytes, seconds) in FLOWS {
        let limits = Limits { message_bytes: bytes.max(1024), ..Limits::default() };
        let topic_type = TopicType::new("bench_msgs/msg/Bytes");
        let publisher = participant.create_raw_publisher("/flow", &topic_type, Qos::keep_last(2), limits)?;
        let stop = Arc::new(AtomicBool::new(false));
        let sender = {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || {
                send(&publisher, wanted_hz, bytes, &stop).map_err(|error| error.to_string())
            })
        };
        let timeout = format!("{}s", if quick { seconds } else { 2 * seconds });
        let output = taut.command(&["topic", "hz", "/flow", "--json", "--timeout", &timeout]).output()?;
        stop.store(true, Ordering::Relaxed);
        let sent_hz = sender.join().map_err(|_| "the publisher panicked")??;
        let text = String::from_utf8(output.stdout)?;
        let report: Value = serde_json::from_str(text.lines().last().ok_or("hz prints nothing")?)?;
        let printed_hz = report["rate_hz"].as_f64().ok_or("hz prints no rate")?;
        println!(
            "{wanted_hz:>10}  {bytes:>9}  {sent_hz:11.3}  {printed_hz:11.3}  {:8.4}",
            printed_hz / sent_hz
        );
        rates.push(Rate { wanted_hz, bytes, sent_hz, printed_hz });
    }
    // A publisher that could not keep its rate has another one in each moment.
    let kept = |rate: &&Rate| (rate.sent_hz / rate.wanted_hz - 1.0).abs() < TOLERANCE;
    let is_wrong = |rate: &&Rate| (rate.printed_hz / rate.wanted_hz - 1.0).abs() > TOLERANCE;
    let wrong = rates.iter().filter(kept).filter(is_wrong);
    let wrong =
        wrong.map(|rate| format!("{} Hz of {} B: hz prints {}", rate.wanted_hz, rate.bytes, rate.printed_hz));
    let wrong = wrong.collect();
    Ok((rates, wrong))
}
