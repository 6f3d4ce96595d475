// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishes each message at its absolute time.
//!
//! # Real-time
//! The thread has a real-time priority, where that is permitted. A message of more than 64 KiB is copied into its loan before it is due, in
//! pieces of 16 KiB, while no other message is due. The thread allocates only for a message that is longer than its publisher was made
//! for. It checks for pauses, leaps and the end at least every 20 ms.

use crate::ring::{HEAD_BYTES, Head, Ring};
use rtrb::Consumer;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use taut_cli::times::Times;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{MessageInfo, PublishError, RawLoan, RawPublisher, SendError};

/// The topic number of a mark in the ring: a pass begins here, and with it a new origin of times.
pub const BEGIN: u32 = u32::MAX;
/// The topic number of a mark in the ring: the end of the bag.
pub const END: u32 = u32::MAX - 1;

/// The longest sleep.
const SLICE_NS: u64 = 20_000_000;
/// A longer message is copied ahead of its time, in pieces, while nothing else is due within `SLACK_NS`.
const LONG_BYTES: usize = 64 << 10;
const PIECE_BYTES: usize = 16 << 10;
const SLACK_NS: u64 = 100_000;
/// The number of heads that are searched for a long message in the time of one piece.
const HEADS_AT_ONCE: usize = 32;
/// The shortest time from one beginning to the next.
const LEAST_PASS_NS: u64 = 1_000_000;
/// The polling interval while the player waits for other threads or for subscriptions.
const LOOK_NS: u64 = 1_000_000;

/// The state that the threads share.
#[derive(Default)]
pub struct Control {
    pub stop: AtomicBool,
    pub is_paused: AtomicBool,
    /// The number of messages to play while paused.
    pub steps: AtomicU32,
    /// Counts leaps to another place. Messages in the ring from before the last leap are dropped.
    pub generation: AtomicU64,
    /// The target of the last leap, as a time of reception.
    pub seek_ns: AtomicU64,
    /// The number of the present pass, from 0.
    pub pass: AtomicU64,
    /// The ring is full, or holds enough to begin, or everything has been read.
    pub is_filled: AtomicBool,
    /// The player has ended.
    pub is_over: AtomicBool,
    /// The time of reception of the last message, and how many were published.
    pub position_ns: AtomicU64,
    pub published: AtomicU64,
}

impl Control {
    /// Continues at another place.
    pub fn seek(&self, to_ns: u64) {
        self.seek_ns.store(to_ns, Ordering::Relaxed);
        self.generation.fetch_add(1, Ordering::Release);
    }

    pub fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn takes_step(&self) -> bool {
        let less = |steps: u32| steps.checked_sub(1);
        self.steps.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less).is_ok()
    }
}

/// Publishes the simulated time.
pub struct Clock {
    pub publisher: RawPublisher,
    pub period_ns: u64,
}

#[derive(Default)]
pub struct Played {
    /// The number of published messages of each topic.
    pub published: Vec<u64>,
    /// How late each message was published.
    pub late: Times,
    /// The timer's part of the lateness: how late the thread woke for each message.
    pub timer: Times,
    /// Messages that were not in memory yet when they were due.
    pub starved: u64,
    /// The number of messages that could not be published, and the reason for the first one.
    pub refused: u64,
    pub refusal: Option<PublishError>,
}

pub struct Player {
    consumer: Consumer<u8>,
    publishers: Vec<RawPublisher>,
    pacing: Pacing,
    played: Played,
    control: Arc<Control>,
}

impl Player {
    pub fn new(
        consumer: Consumer<u8>,
        publishers: Vec<RawPublisher>,
        clock: Option<Clock>,
        rate: f64,
        control: Arc<Control>,
    ) -> Self {
        let published = vec![0; publishers.len()];
        let played = Played { published, ..Played::default() };
        let pacing = Pacing { rate, clock, ..Pacing::default() };
        Player { consumer, publishers, pacing, played, control }
    }

    pub fn run(self) -> Played {
        let Player { mut consumer, publishers, mut pacing, mut played, control } = self;
        let mut ahead = Ahead { publishers: &publishers, scanned: 0, found: None };
        let mut was_empty = false;
        while !control.is_stopped() {
            // Read before the ring: if the feeder has ended, the ring then holds all that it has put in.
            let has_ended = crate::ring::has_ended(&consumer);
            let slots = consumer.slots();
            // This succeeds, because no other thread reads from the ring.
            let Ok(chunk) = consumer.read_chunk(slots) else { continue };
            let ring = Ring::of(&chunk);
            let Some((head, whole)) = ring.message(0) else {
                if has_ended {
                    break;
                }
                was_empty = true;
                sleep_until_monotonic(monotonic_ns() + LOOK_NS);
                continue;
            };
            let generation = control.generation.load(Ordering::Acquire);
            let is_current = generation == pacing.generation;
            match head.topic {
                BEGIN if head.sequence == generation => {
                    control.pass.store(head.publish_ns, Ordering::Release);
                    pacing.begin(head);
                }
                BEGIN => {}
                END if is_current => break,
                END => {}
                _ if is_current => {
                    let Some(due_ns) =
                        pacing.wait(head.log_ns, &control, |left_ns| left_ns > SLACK_NS && ahead.work(ring))
                    else {
                        continue;
                    };
                    played.timer.record(pacing.woke_ns.saturating_sub(due_ns));
                    played.starved += u64::from(was_empty && due_ns + LOOK_NS < monotonic_ns());
                    match ahead.loan(ring, head, whole) {
                        Ok(loan) => publish(loan, head, due_ns, (&control, pacing.generation), &mut played),
                        Err(error) => played.refuse(error),
                    }
                }
                // The message is from before a leap.
                _ => {}
            }
            was_empty = false;
            ahead.pass(whole);
            chunk.commit(whole);
        }
        control.is_over.store(true, Ordering::Release);
        drop(ahead);
        played
    }
}

fn publish(
    mut loan: RawLoan<'_>,
    head: Head,
    due_ns: u64,
    (control, generation): (&Control, u64),
    played: &mut Played,
) {
    let source = MessageInfo {
        sequence_number: head.sequence,
        source_timestamp_ns: head.publish_ns.cast_signed(),
        released_ns: due_ns,
        ..MessageInfo::default()
    };
    loop {
        match loan.publish_again(source) {
            Ok(()) => break,
            // Publisher and subscription keep all, and the queue is full.
            Err(SendError { error: PublishError::Full, loan: again }) => {
                // The player was stopped, or a leap has passed over the message.
                if control.is_stopped() || control.generation.load(Ordering::Acquire) != generation {
                    return;
                }
                loan = again;
                sleep_until_monotonic(monotonic_ns() + LOOK_NS);
            }
            Err(refused) => return played.refuse(refused.error),
        }
    }
    played.late.record(monotonic_ns().saturating_sub(due_ns));
    played.published[head.topic as usize] += 1;
    control.position_ns.store(head.log_ns, Ordering::Relaxed);
    control.published.fetch_add(1, Ordering::Relaxed);
}

/// Copies long messages ahead of their time, while no other message is due: copying a camera's image takes a millisecond.
struct Ahead<'p> {
    publishers: &'p [RawPublisher],
    /// The number of bytes from the front of the ring that were searched.
    scanned: usize,
    found: Option<Long<'p>>,
}

/// The next long message.
struct Long<'p> {
    at: usize,
    loan: RawLoan<'p>,
    copied: usize,
}

impl<'p> Ahead<'p> {
    /// Copies one piece, or searches for the next long message. Returns whether there is more to do.
    fn work(&mut self, ring: Ring<'_>) -> bool {
        if let Some(long) = &mut self.found {
            long.copy(ring, PIECE_BYTES);
            return long.copied < long.loan.len();
        }
        for _ in 0..HEADS_AT_ONCE {
            let Some((head, whole)) = ring.message(self.scanned) else { return false };
            if whole > LONG_BYTES
                && let Ok(loan) = self.publishers[head.topic as usize].loan(whole - HEAD_BYTES)
            {
                self.found = Some(Long { at: self.scanned, loan, copied: 0 });
                return true;
            }
            self.scanned += whole;
        }
        true
    }

    /// A loan that holds the front message.
    fn loan(&mut self, ring: Ring<'_>, head: Head, whole: usize) -> Result<RawLoan<'p>, PublishError> {
        if let Some(mut long) = self.found.take_if(|long| long.at == 0) {
            long.copy(ring, usize::MAX);
            return Ok(long.loan);
        }
        let mut loan = self.publishers[head.topic as usize].loan(whole - HEAD_BYTES)?;
        ring.copy(HEAD_BYTES, &mut loan);
        Ok(loan)
    }

    /// Adjusts the offsets to the removal of the front message.
    fn pass(&mut self, whole: usize) {
        self.scanned = self.scanned.saturating_sub(whole);
        // A leap has passed over this message, so its loan is dropped unpublished.
        self.found.take_if(|long| long.at < whole);
        if let Some(long) = &mut self.found {
            long.at -= whole;
        }
    }
}

impl Long<'_> {
    fn copy(&mut self, ring: Ring<'_>, most: usize) {
        let to = self.loan.len().min(self.copied.saturating_add(most));
        ring.copy(self.at + HEAD_BYTES + self.copied, &mut self.loan[self.copied..to]);
        self.copied = to;
    }
}

impl Played {
    fn refuse(&mut self, why: PublishError) {
        self.refused += 1;
        self.refusal.get_or_insert(why);
    }
}

/// Computes when messages and `/clock` are due.
#[derive(Default)]
struct Pacing {
    /// A time of reception, and the time on `CLOCK_MONOTONIC` at which it is played.
    origin: (u64, u64),
    rate: f64,
    generation: u64,
    began_ns: u64,
    /// The time at which the thread last woke.
    woke_ns: u64,
    /// The time of reception at which playing is paused.
    paused_at: Option<u64>,
    clock: Option<Clock>,
    clock_due_ns: u64,
}

impl Pacing {
    fn begin(&mut self, head: Head) {
        // Repeating a very short bag does not flood its subscriptions.
        let at_ns = monotonic_ns().max(self.began_ns + LEAST_PASS_NS);
        (self.origin, self.generation, self.paused_at) = ((head.log_ns, at_ns), head.sequence, None);
        self.began_ns = at_ns;
        self.tell_time(at_ns, true);
    }

    /// Waits until a message is due, and returns that time. `None` if the player was stopped or a leap was requested. Calls `work`
    /// with the remaining time meanwhile, as long as it returns that there is more to do.
    fn wait(&mut self, log_ns: u64, control: &Control, mut work: impl FnMut(u64) -> bool) -> Option<u64> {
        loop {
            if control.is_stopped() || control.generation.load(Ordering::Acquire) != self.generation {
                return None;
            }
            let now_ns = monotonic_ns();
            if control.is_paused.load(Ordering::Relaxed) {
                let position_ns = position(self.origin, self.rate, now_ns).min(log_ns);
                let paused_at = *self.paused_at.get_or_insert(position_ns);
                if control.takes_step() {
                    self.paused_at = Some(log_ns);
                    self.origin = (log_ns, now_ns);
                    self.tell_time(now_ns, true);
                    return Some(now_ns);
                }
                // The simulated time stands still, but is published for nodes that start now.
                self.origin = (paused_at, now_ns);
                self.tell_time(now_ns, false);
                sleep_until_monotonic(now_ns + LOOK_NS);
                continue;
            }
            if let Some(paused_at) = self.paused_at.take() {
                self.origin = (paused_at, now_ns);
            }
            self.tell_time(now_ns, false);
            let (origin_ns, at_ns) = self.origin;
            let due_ns = at_ns.saturating_add((log_ns.saturating_sub(origin_ns) as f64 / self.rate) as u64);
            if due_ns <= now_ns {
                return Some(due_ns);
            }
            let clock_ns = if self.clock.is_some() { self.clock_due_ns } else { u64::MAX };
            let until_ns = due_ns.min(clock_ns).min(now_ns + SLICE_NS);
            if work(until_ns.saturating_sub(now_ns)) {
                continue;
            }
            sleep_until_monotonic(until_ns);
            self.woke_ns = monotonic_ns();
        }
    }

    /// Publishes the time on `/clock` if its period has passed, or if `is_due`.
    fn tell_time(&mut self, now_ns: u64, is_due: bool) {
        let Some(clock) = &self.clock else { return };
        if now_ns < self.clock_due_ns && !is_due {
            return;
        }
        self.clock_due_ns = (self.clock_due_ns + clock.period_ns).max(now_ns + clock.period_ns / 2);
        let time_ns = position(self.origin, self.rate, now_ns);
        let mut body = [0; 8];
        body[..4].copy_from_slice(&((time_ns / 1_000_000_000) as u32).to_le_bytes());
        body[4..].copy_from_slice(&((time_ns % 1_000_000_000) as u32).to_le_bytes());
        // A full queue of a subscription that keeps all is ignored: it gets a later time.
        let _ = clock.publisher.publish(&body);
    }
}

/// The time of reception that is due now.
fn position((origin_ns, at_ns): (u64, u64), rate: f64, now_ns: u64) -> u64 {
    origin_ns.saturating_add((now_ns.saturating_sub(at_ns) as f64 * rate) as u64)
}
