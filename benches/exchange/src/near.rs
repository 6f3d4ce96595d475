// SPDX-License-Identifier: MIT OR Apache-2.0
//! The near endpoint, which sends first.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tautline_rt::clock::{monotonic_ns, nanoseconds, process_cpu_ns};
use tautline_rt::page_faults;

use crate::job::{Exchange, Job, Line, Measured, Memory, Role, WARM_UP_SHARE, say};
use crate::{Arrivals, Result};

/// A round trip of this length lost a wake-up, which a clean-up repaired later, or the machine stood still.
pub const LATE: Duration = Duration::from_millis(100);
/// Time-out of an answer.
pub const PATIENCE: Duration = Duration::from_millis(500);
/// The same before the first one: there may be no connection yet.
const CONNECTING: Duration = Duration::from_millis(50);
/// Without any answer for this long, there is no connection.
const NEVER: Duration = Duration::from_secs(20);
/// Minimum of round trips of the warm-up.
const WARM_UP: u64 = 30;
/// Capacity for times.
const ROOM: usize = 1 << 18;

/// One endpoint of a system whose user waits for the next message.
pub trait Link {
    /// Sends a message that starts with `number`.
    fn send(&mut self, number: u64) -> Result<()>;

    /// Waits for a message, at most for the given time; returns its number.
    fn receive(&mut self, patience: Duration) -> Result<Option<u64>>;
}

/// Runs the near endpoint over a link, and prints what it measured; a stream is measured by the far one.
///
/// # Errors
/// Errors of the link; no answer ever came.
pub fn drive(job: &Job, link: &mut dyn Link) -> Result<()> {
    match job.exchange {
        Exchange::RoundTrips => say(&Line::Measured(round_trips(job, link)?)),
        Exchange::Stream { window: Some(window) } => stream(&mut Window::new(window), link)?,
        Exchange::Stream { window: None } | Exchange::Paced { .. } => {
            return Err("this system takes no flow over a link".into());
        }
    }
    Ok(())
}

/// Runs an endpoint of round trips over a link, and prints its results: the far one, at `endpoint`, answers until it is told to
/// stop.
///
/// # Errors
/// Errors of the link; no answer ever came.
pub fn play(job: &Job, link: &mut dyn Link, stop: &AtomicBool, endpoint: Option<String>) -> Result<()> {
    if job.role == Role::Near {
        return drive(job, link);
    }
    say(&Line::Ready(endpoint));
    while !stop.load(Ordering::Relaxed) {
        if let Some(number) = link.receive(CONNECTING)? {
            link.send(number)?;
        }
    }
    Ok(())
}

fn round_trips(job: &Job, link: &mut dyn Link) -> Result<Measured> {
    let mut trips = RoundTrips::new(job);
    while let Some(number) = trips.start() {
        link.send(number)?;
        loop {
            match link.receive(trips.patience())? {
                Some(answer) if !trips.end(answer) => {}
                Some(_) => break,
                None => {
                    trips.give_up()?;
                    break;
                }
            }
        }
    }
    Ok(trips.measured())
}

fn stream(window: &mut Window, link: &mut dyn Link) -> Result<()> {
    while !window.is_done() {
        let patience = match window.next() {
            Some(number) => {
                link.send(number)?;
                Duration::ZERO
            }
            None => window.patience(),
        };
        match link.receive(patience)? {
            Some(confirmed) => window.confirm(confirmed),
            None if patience.is_zero() => {}
            None => window.give_up()?,
        }
    }
    Ok(())
}

/// Times the round trips: decides whether there is another, and records each.
#[derive(Debug, Default)]
pub struct RoundTrips {
    times_ns: Vec<u64>,
    lost: u64,
    late: u64,
    number: u64,
    started_ns: u64,
    budget_ns: u64,
    created_ns: u64,
    /// When the first answer came.
    connected_ns: Option<u64>,
    measuring_since_ns: Option<u64>,
    /// The CPU time of this process then.
    cpu_ns: u64,
    /// The page faults of this thread then.
    faults: u64,
    answers: u64,
}

impl RoundTrips {
    /// Before the first round trip.
    pub fn new(job: &Job) -> Self {
        RoundTrips {
            times_ns: Vec::with_capacity(ROOM),
            budget_ns: nanoseconds(job.budget),
            created_ns: monotonic_ns(),
            ..RoundTrips::default()
        }
    }

    /// Starts a round trip; returns the number to send, or `None` when enough is measured.
    pub fn start(&mut self) -> Option<u64> {
        let now = monotonic_ns();
        match (self.measuring_since_ns, self.connected_ns) {
            (Some(since), _) if now - since >= self.budget_ns => return None,
            (None, Some(connected)) => {
                let warming_ns = now - connected;
                // A system that loses most of its messages never finishes its warm-up.
                let is_warm = warming_ns >= self.budget_ns / u64::from(WARM_UP_SHARE)
                    && (self.answers >= WARM_UP || warming_ns >= self.budget_ns * 2);
                if is_warm {
                    (self.cpu_ns, self.faults) = (process_cpu_ns(), page_faults().minor);
                    self.measuring_since_ns = Some(now);
                }
            }
            _ => {}
        }
        self.number += 1;
        self.started_ns = now;
        Some(self.number)
    }

    /// Ends a round trip, unless the answer is to an earlier request.
    pub fn end(&mut self, answer: u64) -> bool {
        let now = monotonic_ns();
        if answer != self.number {
            return false;
        }
        self.answers += 1;
        self.connected_ns.get_or_insert(now);
        if self.measuring_since_ns.is_some() {
            let round_trip_ns = now - self.started_ns;
            self.late += u64::from(round_trip_ns >= nanoseconds(LATE));
            self.times_ns.push(round_trip_ns / 2);
        }
        true
    }

    /// How long to wait for an answer.
    pub fn patience(&self) -> Duration {
        if self.connected_ns.is_some() { PATIENCE } else { CONNECTING }
    }

    /// Whether the answer timed out.
    pub fn is_overdue(&self) -> bool {
        monotonic_ns() - self.started_ns >= nanoseconds(self.patience())
    }

    /// Counts a missing answer.
    ///
    /// # Errors
    /// No answer ever came.
    pub fn give_up(&mut self) -> Result<()> {
        if self.measuring_since_ns.is_some() {
            self.lost += 1;
        }
        never(self.connected_ns.is_some(), self.created_ns)
    }

    pub fn measured(self) -> Measured {
        let seconds = self.measuring_since_ns.map_or(0.0, |since| (monotonic_ns() - since) as f64 / 1e9);
        let cpu_ns = process_cpu_ns() - self.cpu_ns;
        let faults = page_faults().minor - self.faults;
        let (messages, memory) = (self.times_ns.len() as u64, Memory::of_exchange());
        let RoundTrips { times_ns, lost, late, .. } = self;
        Measured { times_ns, lost, late, seconds, cpu_ns, faults, messages, memory, ..Measured::default() }
    }
}

/// The window of a stream.
#[derive(Debug, Default)]
pub struct Window {
    size: u64,
    sent: u64,
    confirmed: u64,
    is_connected: bool,
    is_done: bool,
    created_ns: u64,
}

impl Window {
    /// Before the first message.
    pub fn new(size: u64) -> Self {
        Window { size, created_ns: monotonic_ns(), ..Window::default() }
    }

    /// The number of the message to send now, if there is room. Before the first confirmation, one at a time.
    #[expect(clippy::should_implement_trait, reason = "it continues after None")]
    pub fn next(&mut self) -> Option<u64> {
        let under_way = self.sent - self.confirmed;
        let room = if self.is_connected { self.size } else { 1 };
        (under_way < room).then(|| {
            self.sent += 1;
            self.sent
        })
    }

    /// The far endpoint has received all up to this number, or enough.
    pub fn confirm(&mut self, number: u64) {
        self.is_connected = true;
        self.is_done |= number == Arrivals::DONE;
        self.confirmed = self.confirmed.max(number.min(self.sent));
    }

    /// Whether the far endpoint has received enough.
    pub fn is_done(&self) -> bool {
        self.is_done
    }

    /// How long to wait for a confirmation.
    pub fn patience(&self) -> Duration {
        if self.is_connected { PATIENCE } else { CONNECTING }
    }

    /// No confirmation came: messages in flight are lost, which the far endpoint counts.
    ///
    /// # Errors
    /// No confirmation ever came.
    pub fn give_up(&mut self) -> Result<()> {
        self.confirmed = self.sent;
        never(self.is_connected, self.created_ns)
    }
}

fn never(is_connected: bool, since_ns: u64) -> Result<()> {
    if !is_connected && monotonic_ns() - since_ns > nanoseconds(NEVER) {
        return Err(format!("the other process did not answer within {} s", NEVER.as_secs()).into());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_is_not_exceeded_and_goes_on_after_a_loss() {
        let mut window = Window::new(3);
        assert_eq!([window.next(), window.next()], [Some(1), None], "one until the far endpoint answers");
        window.give_up().unwrap();
        assert_eq!([window.next(), window.next()], [Some(2), None]);
        window.confirm(2);
        assert_eq!([(); 4].map(|()| window.next()), [Some(3), Some(4), Some(5), None]);
        window.confirm(4);
        assert_eq!([(); 3].map(|()| window.next()), [Some(6), Some(7), None]);
        window.confirm(1);
        assert_eq!(window.next(), None, "an old one changes nothing");
        window.give_up().unwrap();
        assert_eq!(window.next(), Some(8));
        window.confirm(Arrivals::DONE);
        assert!(window.is_done());
    }
}
