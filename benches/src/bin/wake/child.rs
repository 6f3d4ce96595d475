// SPDX-License-Identifier: MIT OR Apache-2.0
//! One process of a pair.

use std::time::Duration;

use rustix::process::{Signal, set_parent_process_death_signal};
use tautline_benches::Distribution;
use tautline_benches::pair::{Line, Measured};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{CoreSet, MemoryLock, Policy, lock_memory, prefault_stack, set_affinity, set_policy};

use crate::payload::{LATE, STOP};
use crate::plan::{Job, Mode, PRIORITY, Role, WARM_UP_SHARE};
use crate::{Result, futex, iceoryx, tautline};

/// How long a wait lasts before the receiver looks whether a message came without a wake-up.
pub const WAIT: Duration = Duration::from_millis(100);
/// How many waits without a message mean that none will come: 2 s.
const PATIENCE: u32 = 20;

/// One end of a system whose user waits for the next message.
///
/// Systems that call their user instead (callbacks) have no `Link`: they use a [`Pinger`] in their callback.
pub trait Link {
    /// Sends message `number`, writing as much of it as the job's payload says.
    fn send(&mut self, number: u64) -> Result<()>;

    /// Waits up to [`WAIT`] for the next message.
    fn receive(&mut self) -> Result<Option<Received>>;
}

/// A message.
pub struct Received {
    pub number: u64,
    /// It was found only by looking after the wait had timed out: its wake-up was lost.
    pub late: bool,
}

/// Runs the job given as JSON.
pub fn run(job: &str) -> Result<()> {
    // Nobody is left to stop a busy-polling child when the parent is killed.
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let job: Job = serde_json::from_str(job)?;
    let mut pinger = Pinger::new(&job);
    run_mode(&job, &mut pinger)?;
    if job.role == Role::Ping {
        Line::Measured(Measured { counts: pinger.distribution.counts(), lost: pinger.lost }).say()?;
    }
    Ok(())
}

/// Runs one side of the exchange to its end. A system provides one function for both sides; the ping side uses the
/// pinger, the pong side says [`Line::Ready`] once it can receive and returns after [`STOP`].
fn run_mode(job: &Job, pinger: &mut Pinger) -> Result<()> {
    match job.mode {
        Mode::FutexBlocking | Mode::FutexOneCore => futex::run(job, |link| exchange(job, pinger, link)),
        Mode::IceoryxBusyPoll => iceoryx::run_busy_poll(job, |link| exchange(job, pinger, link)),
        Mode::IceoryxWaitSet => iceoryx::run_waitset(job, |link| exchange(job, pinger, link)),
        Mode::TautlineSameCore | Mode::TautlineTwoCores | Mode::TautlineOneCore | Mode::TautlineBusyPoll => {
            tautline::run(job, pinger)
        }
    }
}

/// Binds and prioritises the current thread, after its system has set itself up.
fn go_realtime(job: &Job) -> Result<()> {
    set_affinity(CoreSet::one(job.core()))?;
    if job.realtime {
        lock_memory(MemoryLock::OnFault)?;
        prefault_stack(128 * 1024);
        set_policy(Policy::Fifo(PRIORITY))?;
    }
    Ok(())
}

/// Plays one side over a link.
fn exchange(job: &Job, pinger: &mut Pinger, link: &mut dyn Link) -> Result<()> {
    go_realtime(job)?;
    match job.role {
        Role::Ping => ping(pinger, link)?,
        Role::Pong => {
            Line::Ready.say()?;
            pong(link)?;
        }
    }
    if job.realtime {
        set_policy(Policy::Other { nice: 0 })?;
    }
    Ok(())
}

fn ping(pinger: &mut Pinger, link: &mut dyn Link) -> Result<()> {
    while let Some(number) = pinger.start() {
        link.send(number)?;
        let answer = receive(link)?;
        pinger.end(answer)?;
    }
    link.send(STOP)
}

fn pong(link: &mut dyn Link) -> Result<()> {
    loop {
        let question = receive(link)?;
        if question.number == STOP {
            return Ok(());
        }
        link.send(question.number | if question.late { LATE } else { 0 })?;
    }
}

fn receive(link: &mut dyn Link) -> Result<Received> {
    for _ in 0..PATIENCE {
        if let Some(received) = link.receive()? {
            return Ok(received);
        }
    }
    Err(format!("no message for {} s: it was lost, or the peer is gone", (WAIT * PATIENCE).as_secs()).into())
}

/// The clock of the round trips: says when there is another and records how long each took.
pub struct Pinger {
    distribution: Distribution,
    lost: u64,
    number: u64,
    started_ns: u64,
    budget_ns: u64,
    /// While `None`: warming up, nothing is recorded.
    measuring_since_ns: Option<u64>,
    warm_up_since_ns: u64,
}

impl Pinger {
    /// The fewest round trips of the warm-up: more than any system has buffers, so that each has been touched.
    const WARM_UP: u64 = 30;

    pub fn new(job: &Job) -> Self {
        Self {
            distribution: Distribution::new(),
            lost: 0,
            number: 0,
            started_ns: 0,
            budget_ns: u64::try_from(job.budget.as_nanos()).unwrap_or(u64::MAX),
            measuring_since_ns: None,
            warm_up_since_ns: 0,
        }
    }

    /// Starts the clock of the next round trip; returns the number to send, or `None` when enough was measured.
    ///
    /// # Real-time
    ///
    /// Wait-free; no allocation; no syscall.
    pub fn start(&mut self) -> Option<u64> {
        let now = monotonic_ns();
        match self.measuring_since_ns {
            Some(since) if now - since >= self.budget_ns => return None,
            Some(_) => {}
            None if self.number == 0 => self.warm_up_since_ns = now,
            None => {
                let warm = now - self.warm_up_since_ns >= self.budget_ns / u64::from(WARM_UP_SHARE)
                    && self.number >= Self::WARM_UP;
                self.measuring_since_ns = warm.then_some(now);
            }
        }
        self.number += 1;
        self.started_ns = now;
        Some(self.number)
    }

    /// Stops the clock: the answer has arrived.
    ///
    /// # Real-time
    ///
    /// Wait-free; no allocation (but for the error); no syscall.
    pub fn end(&mut self, answer: Received) -> Result<()> {
        let round_trip_ns = monotonic_ns() - self.started_ns;
        if answer.number & !LATE != self.number {
            return Err(format!("answer {} to question {}", answer.number & !LATE, self.number).into());
        }
        if answer.late || answer.number & LATE != 0 {
            self.lost += 1;
        } else if self.measuring_since_ns.is_some() {
            self.distribution.record(round_trip_ns / 2);
        }
        Ok(())
    }
}
