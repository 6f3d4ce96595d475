// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rates of publishers, from the counters that they keep in shared memory. Reading these does not affect the publishers.

use crate::verb::Outcome;
use std::collections::BTreeMap;
use std::time::Instant;
use tautline_transport::{EndpointKind, Gid, GraphSnapshot, Sent, Visitor};

/// Measures rates from one reading of the counters to the next. It holds the previous reading.
#[derive(Default)]
pub struct RateMeter(BTreeMap<Gid, (Instant, Sent)>);

#[derive(Clone, Copy, Debug, Default)]
pub struct Rate {
    pub messages_hz: f64,
    pub bytes_per_s: f64,
}

/// The rates of this host's publishers; `None` for a publisher without a previous reading. Publishers of other hosts have no counters here.
pub type Rates = BTreeMap<Gid, Option<Rate>>;

impl RateMeter {
    /// Reads the counters, and returns the rates since the previous reading.
    pub fn measure(&mut self, visitor: &mut Visitor, graph: &GraphSnapshot) -> Outcome<Rates> {
        let (before, mut rates) = (std::mem::take(&mut self.0), Rates::new());
        for end in graph.endpoints.iter().filter(|end| end.kind == EndpointKind::Publisher) {
            let Some(sent) = visitor.sent(end)? else { continue };
            let now = Instant::now();
            let rate = before.get(&end.gid).map(|(then, before)| {
                let seconds = (now - *then).as_secs_f64();
                Rate {
                    messages_hz: per_second(sent.messages, before.messages, seconds),
                    bytes_per_s: per_second(sent.bytes, before.bytes, seconds),
                }
            });
            rates.insert(end.gid, rate);
            self.0.insert(end.gid, (now, sent));
        }
        Ok(rates)
    }
}

/// The rate at which a count grew.
pub fn per_second(now: u64, before: u64, seconds: f64) -> f64 {
    if seconds > 0.0 { now.saturating_sub(before) as f64 / seconds } else { 0.0 }
}
