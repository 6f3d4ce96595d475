// SPDX-License-Identifier: MIT OR Apache-2.0
//! The far endpoint, which answers.

use tautline_rt::clock::{monotonic_ns, nanoseconds};

use crate::job::{Exchange, Job, Line, Measured, WARM_UP_SHARE, say};

/// The received messages of a stream.
#[derive(Debug, Default)]
pub struct Arrivals {
    budget_ns: u64,
    /// A confirmation is sent after this many messages.
    stride: u64,
    unconfirmed: u64,
    first_ns: Option<u64>,
    measuring_since_ns: Option<u64>,
    last_ns: u64,
    last_number: u64,
    is_complete: bool,
    measured: Measured,
}

impl Arrivals {
    /// The answer when enough has arrived.
    pub const DONE: u64 = u64::MAX;

    /// Before the first message.
    pub fn new(job: &Job) -> Self {
        let stride = match job.exchange {
            Exchange::Stream { window: Some(window) } => (window / 4).max(1),
            _ => 64,
        };
        Arrivals {
            budget_ns: nanoseconds(job.budget),
            stride,
            measured: Measured { times_ns: Vec::with_capacity(1 << 17), ..Measured::default() },
            ..Arrivals::default()
        }
    }

    /// Handles message `number`. Returns the answer, if one is due. Prints the results once enough is measured.
    pub fn arrive(&mut self, number: u64) -> Option<u64> {
        let was_complete = self.is_complete;
        let answer = self.arrive_at(number, monotonic_ns());
        if self.is_complete && !was_complete {
            say(&Line::Measured(std::mem::take(&mut self.measured)));
        }
        answer
    }

    fn arrive_at(&mut self, number: u64, now: u64) -> Option<u64> {
        if self.is_complete {
            return Some(Self::DONE);
        }
        let first = *self.first_ns.get_or_insert(now);
        if let Some(since) = self.measuring_since_ns {
            self.measured.times_ns.push(now - self.last_ns);
            self.measured.lost += number.saturating_sub(self.last_number + 1);
            self.measured.seconds = (now - since) as f64 / 1e9;
            if now - since >= self.budget_ns {
                self.is_complete = true;
                return Some(Self::DONE);
            }
        } else if now - first >= self.budget_ns / u64::from(WARM_UP_SHARE) {
            self.measuring_since_ns = Some(now);
        }
        (self.last_ns, self.last_number) = (now, number);
        self.unconfirmed += 1;
        // The first messages come one at a time: see `Window`.
        if self.unconfirmed >= self.stride || self.measuring_since_ns.is_none() && number < 1000 {
            self.unconfirmed = 0;
            return Some(number);
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn gaps_are_counted_once_it_is_warm_and_the_end_is_said() {
        let exchange = Exchange::Stream { window: Some(8) };
        let job = Job { exchange, budget: Duration::from_nanos(800), ..Job::default() };
        let mut arrivals = Arrivals::new(&job);
        assert_eq!(arrivals.arrive_at(1, 1000), Some(1));
        assert_eq!(arrivals.arrive_at(5, 1050), Some(5), "a gap during the warm-up does not count");
        assert_eq!(arrivals.arrive_at(6, 1100), None, "warm");
        assert_eq!(arrivals.arrive_at(7, 1200), Some(7), "every second of a window of 8");
        assert_eq!(arrivals.arrive_at(10, 1300), None);
        assert_eq!((arrivals.arrive_at(11, 1900), arrivals.is_complete), (Some(Arrivals::DONE), true));
        assert_eq!(arrivals.arrive_at(12, 2000), Some(Arrivals::DONE));
        let measured = arrivals.measured;
        assert_eq!((measured.times_ns, measured.lost), (vec![100, 100, 600], 2));
        assert!((measured.seconds - 800e-9).abs() < 1e-12);
    }
}
