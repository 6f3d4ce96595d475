// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much publishers send, by what they count anyway: nobody is disturbed.

use crate::verb::Outcome;
use std::collections::BTreeMap;
use std::time::Instant;
use tautline::{EndpointKind, GraphSnapshot};
use tautline_transport::{Gid, Sent, Visitor};

/// What the look before read.
#[derive(Default)]
pub struct Counts(BTreeMap<Gid, (Instant, Sent)>);

/// What a publisher sends.
#[derive(Clone, Copy, Debug, Default)]
pub struct Rate {
    pub messages_hz: f64,
    pub bytes_per_s: f64,
}

/// Of the publishers of this host; `None` for one that the look before did not see. What is elsewhere nobody counts here.
pub type Rates = BTreeMap<Gid, Option<Rate>>;

impl Counts {
    /// What was sent since the look before.
    pub fn look(&mut self, visitor: &mut Visitor, graph: &GraphSnapshot) -> Outcome<Rates> {
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

/// How fast a count grew.
pub fn per_second(now: u64, before: u64, seconds: f64) -> f64 {
    if seconds > 0.0 { now.saturating_sub(before) as f64 / seconds } else { 0.0 }
}
