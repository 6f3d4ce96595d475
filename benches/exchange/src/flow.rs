// SPDX-License-Identifier: MIT OR Apache-2.0
//! A flow: one way, from one process to subscriptions in others, without confirmations, at a rate or at full speed.
//!
//! The near endpoint sends messages of number 0 until it is told to start; by then every subscription has received one. Messages
//! are numbered per topic; the first ninth is the warm-up.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use tautline_rt::clock::{monotonic_ns, nanoseconds, process_cpu_ns, sleep_until_monotonic};

use crate::job::{Exchange, Job, Line, Measured, Memory, WARM_UP_SHARE, say};
use crate::{Result, Stamp};

/// Period of messages of number 0 at full speed, and an addition per byte, so that no system is flooded before it is measured.
const GREETING_NS: u64 = 1_000_000;
const GREETING_NS_PER_BYTE: u64 = 20;
/// At full speed, one in this many messages is timed.
const SAMPLED: u64 = 16;
/// Maximum of times stored per subscription.
const ROOM: usize = 1 << 16;

/// The message numbers of a flow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Numbers {
    /// The last one of the warm-up.
    warm: u64,
    /// The last one, for a flow at a rate.
    last: Option<u64>,
    /// Between two messages of any topics.
    period_ns: u64,
}

impl Numbers {
    fn of(job: &Job) -> Self {
        let rate = match job.exchange {
            Exchange::Paced { rate } => rate,
            Exchange::RoundTrips | Exchange::Stream { .. } => {
                return Numbers::default();
            }
        };
        let measured = (rate * job.budget.as_secs_f64() / topics(job) as f64).ceil().max(1.0) as u64;
        let warm = measured.div_ceil(u64::from(WARM_UP_SHARE));
        Numbers { warm, last: Some(warm + measured), period_ns: (1e9 / rate) as u64 }
    }
}

fn topics(job: &Job) -> usize {
    job.way.topics.max(1)
}

/// The near endpoint: decides which topic gets which message, and when.
#[derive(Debug, Default)]
pub struct Source {
    numbers: Numbers,
    topics: usize,
    at_once: bool,
    times_sending: bool,
    go: Arc<AtomicBool>,
    /// Period of messages of number 0 at full speed; flows at a rate use theirs.
    greeting_ns: u64,
    /// Messages sent so far: of number 0 or, since `started_ns`, of others.
    sent: u64,
    started_ns: Option<u64>,
    warm_up_ns: u64,
    budget_ns: u64,
    /// CPU time, clock and messages at the end of the warm-up.
    warm: Option<(u64, u64, u64)>,
    /// At a rate: measured messages that were due before the previous one was sent.
    late: u64,
}

impl Source {
    /// Before the first message; `go` is the flag of [`stop_flag`](crate::stop_flag).
    pub fn new(job: &Job, go: Arc<AtomicBool>) -> Self {
        let (numbers, budget_ns) = (Numbers::of(job), nanoseconds(job.budget));
        Source {
            numbers,
            topics: topics(job),
            at_once: job.way.at_once,
            times_sending: job.way.times_sending,
            go,
            greeting_ns: match numbers.last {
                Some(_) => numbers.period_ns * topics(job) as u64,
                None => GREETING_NS.max(GREETING_NS_PER_BYTE * job.payload_bytes as u64),
            },
            warm_up_ns: budget_ns / u64::from(WARM_UP_SHARE),
            budget_ns,
            ..Source::default()
        }
    }

    /// Runs the near endpoint, whose `send` sends a stamp on a topic, and prints the results.
    ///
    /// # Errors
    /// Those of `send`.
    pub fn play(job: &Job, go: Arc<AtomicBool>, send: impl FnMut(usize, Stamp) -> Result<()>) -> Result<()> {
        say(&Line::Measured(Source::new(job, go).run(send)?));
        Ok(())
    }

    /// As [`play`](Self::play), but returns the results.
    ///
    /// # Errors
    /// Those of `send`.
    pub fn run(mut self, mut send: impl FnMut(usize, Stamp) -> Result<()>) -> Result<Measured> {
        let measured = self.numbers.last.map_or(0, |last| last - self.numbers.warm) as usize * self.topics;
        // Room for all: nothing is allocated between messages.
        let mut times_ns = Vec::with_capacity(if self.times_sending { measured } else { 0 });
        while let Some((topic, stamp)) = self.next() {
            if self.warm.is_none() || times_ns.len() == times_ns.capacity() {
                send(topic, stamp)?;
            } else {
                let start_ns = monotonic_ns();
                send(topic, stamp)?;
                times_ns.push(monotonic_ns() - start_ns);
            }
        }
        Ok(Measured { times_ns, ..self.measured() })
    }

    /// Sleeps until a message is due; returns its topic and stamp, or `None` at the end. If it was due while the previous one was
    /// being sent, the stamp has the due time, so that a system that blocks its sender does not shorten its own latencies.
    #[expect(clippy::should_implement_trait, reason = "it sleeps")]
    pub fn next(&mut self) -> Option<(usize, Stamp)> {
        let topic = (self.sent % self.topics as u64) as usize;
        let Some(started) = self.started_ns else { return Some(self.greet(topic)) };
        let number = self.sent / self.topics as u64 + 1;
        // The first of those that are sent at once.
        let turn = if self.at_once { self.sent - topic as u64 } else { self.sent };
        let due = self.numbers.last.map(|_| started + turn * self.numbers.period_ns);
        let follows = self.at_once && topic != 0;
        let mut now = monotonic_ns();
        let is_late = !follows && due.is_some_and(|due| now > due);
        let is_over = match (self.numbers.last, due) {
            (Some(last), Some(due)) => {
                if !is_late && !follows {
                    sleep_until_monotonic(due);
                    now = monotonic_ns();
                }
                number > last
            }
            _ => now - started >= self.warm_up_ns + self.budget_ns,
        };
        if is_over {
            return None;
        }
        let is_warm = match self.numbers.last {
            Some(_) => number > self.numbers.warm,
            None => now - started >= self.warm_up_ns,
        };
        if is_warm && self.warm.is_none() {
            self.warm = Some((process_cpu_ns(), now, self.sent));
        }
        self.late += u64::from(is_late && is_warm);
        self.sent += 1;
        Some((topic, Stamp { number, sent_ns: due.filter(|_| is_late).unwrap_or(now) }))
    }

    fn greet(&mut self, topic: usize) -> (usize, Stamp) {
        if topic == 0 {
            if self.go.load(Ordering::Relaxed) {
                self.sent = 0;
                self.started_ns = Some(monotonic_ns() + self.greeting_ns);
            }
            sleep_until_monotonic(monotonic_ns() + self.greeting_ns);
        }
        self.sent += u64::from(self.started_ns.is_none());
        (topic, Stamp { number: 0, sent_ns: monotonic_ns() })
    }

    /// The results.
    pub fn measured(&self) -> Measured {
        let (cpu_ns, since_ns, before) = self.warm.unwrap_or_default();
        Measured {
            cpu_ns: process_cpu_ns() - cpu_ns,
            seconds: (monotonic_ns() - since_ns) as f64 / 1e9,
            messages: self.sent - before,
            late: self.late,
            memory: Memory::of_exchange(),
            ..Measured::default()
        }
    }
}

/// The far endpoint: what arrives at all subscriptions of the process.
#[derive(Debug)]
pub struct Sink {
    numbers: Numbers,
    topics: usize,
    state: Arc<SinkState>,
    inlets: Vec<Arc<Mutex<Counts>>>,
}

#[derive(Debug, Default)]
struct SinkState {
    inlets: usize,
    connected: AtomicUsize,
    /// When the first measured message arrived.
    warm_cpu_ns: AtomicU64,
    /// At a rate: subscriptions that have received the last message, and when all had.
    complete: AtomicUsize,
    complete_cpu_ns: AtomicU64,
}

/// The part of a [`Sink`] for one subscription.
#[derive(Clone, Debug)]
pub struct Inlet {
    numbers: Numbers,
    warm_up_ns: u64,
    state: Arc<SinkState>,
    counts: Arc<Mutex<Counts>>,
}

#[derive(Debug, Default)]
struct Counts {
    is_connected: bool,
    /// Number and latency; at full speed, for each sampled message the mean time since the previous sample.
    times_ns: Vec<(u64, u64)>,
    received: u64,
    lost: u64,
    last_number: u64,
    /// When the first message of a stream arrived, and when measuring began.
    first_ns: Option<u64>,
    since_ns: Option<u64>,
    sampled_ns: u64,
    last_ns: u64,
}

impl Sink {
    /// Before the first message.
    pub fn new(job: &Job) -> Self {
        let inlets = topics(job) * job.way.subscribers.max(1);
        let counts = || Counts { times_ns: Vec::with_capacity(ROOM / topics(job)), ..Counts::default() };
        Sink {
            numbers: Numbers::of(job),
            topics: topics(job),
            state: Arc::new(SinkState { inlets, ..SinkState::default() }),
            inlets: (0..inlets).map(|_| Arc::new(Mutex::new(counts()))).collect(),
        }
    }

    /// The part of each subscription, with its topic's index.
    pub fn inlets(&self, job: &Job) -> Vec<(usize, Inlet)> {
        let inlet = |(index, counts): (usize, &Arc<Mutex<Counts>>)| {
            let inlet = Inlet {
                numbers: self.numbers,
                warm_up_ns: nanoseconds(job.budget) / u64::from(WARM_UP_SHARE),
                state: self.state.clone(),
                counts: counts.clone(),
            };
            (index % self.topics, inlet)
        };
        self.inlets.iter().enumerate().map(inlet).collect()
    }

    /// The results. With several subscriptions to a topic: the time when a message had arrived at all of them.
    pub fn measured(&self) -> Measured {
        let end_cpu_ns = match self.state.complete_cpu_ns.load(Ordering::Relaxed) {
            0 => process_cpu_ns(),
            complete => complete,
        };
        let cpu_ns = end_cpu_ns - self.state.warm_cpu_ns.load(Ordering::Relaxed);
        let mut measured = Measured { cpu_ns, ..Measured::default() };
        let mut arrivals: Vec<(u64, u64)> = Vec::new();
        for counts in &self.inlets {
            let counts = counts.lock().unwrap_or_else(PoisonError::into_inner);
            measured.messages += counts.received;
            measured.lost += match self.numbers.last {
                Some(last) => (last - self.numbers.warm).saturating_sub(counts.received),
                None => counts.lost,
            };
            let seconds = counts.since_ns.map_or(0.0, |since| (counts.last_ns - since) as f64 / 1e9);
            measured.seconds = measured.seconds.max(seconds);
            match (self.numbers.last, counts.since_ns) {
                // Too few of a stream for a sample.
                (None, Some(since)) if counts.times_ns.is_empty() && counts.received > 0 => {
                    arrivals.push((counts.last_number, (counts.last_ns - since) / counts.received));
                }
                _ => arrivals.extend(&counts.times_ns),
            }
        }
        let subscribers = self.inlets.len() / self.topics;
        if self.topics == 1 && subscribers > 1 {
            arrivals = to_the_last(arrivals, subscribers);
        }
        let (numbers, times_ns) = arrivals.into_iter().unzip();
        measured.times_ns = times_ns;
        measured.numbers = if self.topics == 1 { numbers } else { Vec::new() };
        measured
    }
}

/// The longest time of each number that arrived everywhere.
pub fn to_the_last(mut arrivals: Vec<(u64, u64)>, receivers: usize) -> Vec<(u64, u64)> {
    arrivals.sort_unstable();
    let of_all = |group: &[(u64, u64)]| (group.len() == receivers).then(|| group[receivers - 1]);
    arrivals.chunk_by(|a, b| a.0 == b.0).filter_map(of_all).collect()
}

impl Inlet {
    /// Handles a message.
    pub fn arrive(&self, stamp: Stamp) {
        let now = monotonic_ns();
        // Nothing else holds it before the end.
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        if !counts.is_connected {
            counts.is_connected = true;
            self.connect(now);
        }
        if stamp.number > 0 {
            match self.numbers.last {
                Some(_) => self.count_paced(&mut counts, stamp, now),
                None => self.count_streamed(&mut counts, stamp.number, now),
            }
        }
    }

    fn connect(&self, now: u64) {
        if self.state.connected.fetch_add(1, Ordering::Relaxed) + 1 == self.state.inlets {
            say(&Line::Connected { all_ns: now });
        }
    }

    fn begin(&self) {
        let warm = &self.state.warm_cpu_ns;
        let is_first = warm.load(Ordering::Relaxed) == 0
            && warm.compare_exchange(0, process_cpu_ns(), Ordering::Relaxed, Ordering::Relaxed).is_ok();
        if is_first {
            say(&Line::Warm);
        }
    }

    fn count_paced(&self, counts: &mut Counts, stamp: Stamp, now: u64) {
        if stamp.number <= self.numbers.warm {
            return;
        }
        if counts.since_ns.is_none() {
            counts.since_ns = Some(now);
            self.begin();
        }
        counts.received += 1;
        counts.last_ns = now;
        counts.times_ns.push((stamp.number, now.saturating_sub(stamp.sent_ns)));
        if Some(stamp.number) == self.numbers.last {
            self.complete();
        }
    }

    fn complete(&self) {
        if self.state.complete.fetch_add(1, Ordering::Relaxed) + 1 == self.state.inlets {
            self.state.complete_cpu_ns.store(process_cpu_ns(), Ordering::Relaxed);
            say(&Line::Complete);
        }
    }

    fn count_streamed(&self, counts: &mut Counts, number: u64, now: u64) {
        let first = *counts.first_ns.get_or_insert(now);
        if counts.since_ns.is_some() {
            counts.received += 1;
            counts.lost += number.saturating_sub(counts.last_number + 1);
            if counts.received.is_multiple_of(SAMPLED) && counts.times_ns.len() < ROOM {
                counts.times_ns.push((number, (now - counts.sampled_ns) / SAMPLED));
                counts.sampled_ns = now;
            }
        } else if now - first >= self.warm_up_ns {
            counts.since_ns = Some(now);
            counts.sampled_ns = now;
            self.begin();
        }
        (counts.last_number, counts.last_ns) = (number, now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Way;
    use std::time::Duration;

    fn job(exchange: Exchange, topics: usize, subscribers: usize) -> Job {
        Job {
            exchange,
            payload_bytes: 64,
            budget: Duration::from_millis(8),
            way: Way { topics, subscribers, ..Way::default() },
            ..Job::default()
        }
    }

    #[test]
    fn topics_take_turns_and_the_warm_up_is_sent_too() {
        // 8 ms at 1000/s on two topics: 4 messages each, and one of the warm-up.
        let job = job(Exchange::Paced { rate: 1000.0 }, 2, 1);
        let go = Arc::new(AtomicBool::new(false));
        let mut source = Source::new(&job, go.clone());
        let mut next = || source.next().map(|(topic, stamp)| (topic, stamp.number));
        assert_eq!([next(), next(), next()], [Some((0, 0)), Some((1, 0)), Some((0, 0))]);
        go.store(true, Ordering::Relaxed);
        let sent: Vec<_> = std::iter::from_fn(next).filter(|(_, number)| *number > 0).collect();
        let expected: Vec<_> = (1..=5).flat_map(|number| [(0, number), (1, number)]).collect();
        assert_eq!(sent, expected);
        assert_eq!(source.measured().messages, 8);
    }

    #[test]
    fn what_was_due_while_the_message_before_was_sent_is_stamped_so() {
        // A message is due every nanosecond: faster than any sender.
        let job = Job { budget: Duration::from_nanos(8), ..job(Exchange::Paced { rate: 1e9 }, 1, 1) };
        let mut source = Source::new(&job, Arc::new(AtomicBool::new(true)));
        let stamps: Vec<Stamp> = std::iter::from_fn(|| source.next().map(|(_, stamp)| stamp)).collect();
        let due = |index: usize| stamps[1].sent_ns + index as u64;
        assert_eq!(stamps.len(), 10, "one that says that it goes, one of the warm-up, eight");
        assert!(
            stamps[1..].iter().enumerate().all(|(index, stamp)| stamp.sent_ns == due(index)),
            "{stamps:?}"
        );
        assert_eq!(source.measured().late, 8);
    }

    #[test]
    fn what_follows_at_once_is_not_waited_for_and_never_late() {
        let way = Way { at_once: true, topics: 2, subscribers: 1, ..Way::default() };
        let job = Job { budget: Duration::from_nanos(8), way, ..job(Exchange::Paced { rate: 1e9 }, 2, 1) };
        let go = Arc::new(AtomicBool::new(true));
        let mut source = Source::new(&job, go);
        let sent: Vec<_> =
            std::iter::from_fn(|| source.next()).filter(|(_, stamp)| stamp.number > 0).collect();
        for pair in sent.chunks(2) {
            assert_eq!((pair[0].0, pair[1].0, pair[0].1.number), (0, 1, pair[1].1.number));
            assert!(pair[0].1.sent_ns <= pair[1].1.sent_ns);
        }
        assert_eq!((sent.len(), source.measured().messages, source.measured().late), (10, 8, 4));
    }

    #[test]
    fn sending_is_timed_if_asked_for_and_after_the_warm_up() {
        for (times_sending, timed) in [(false, 0), (true, 8)] {
            let mut job = job(Exchange::Paced { rate: 1e9 }, 2, 1);
            (job.budget, job.way.times_sending) = (Duration::from_nanos(8), times_sending);
            let source = Source::new(&job, Arc::new(AtomicBool::new(true)));
            assert_eq!(source.run(|_, _| Ok(())).unwrap().times_ns.len(), timed);
        }
    }

    #[test]
    fn what_is_missing_at_one_of_two_subscriptions_is_lost_and_not_timed() {
        let job = job(Exchange::Paced { rate: 1000.0 }, 1, 2);
        let sink = Sink::new(&job);
        for (index, (_, inlet)) in sink.inlets(&job).into_iter().enumerate() {
            // 8 are measured, after one of the warm-up.
            for number in (0..=9).filter(|number| index == 0 || *number != 5) {
                inlet.arrive(Stamp { number, sent_ns: 0 });
            }
        }
        let measured = sink.measured();
        assert_eq!((measured.messages, measured.lost), (15, 1));
        assert_eq!(measured.numbers, [2, 3, 4, 6, 7, 8, 9]);
    }

    #[test]
    fn a_stream_of_few_messages_has_a_time_too() {
        let job = Job { budget: Duration::ZERO, ..job(Exchange::Stream { window: None }, 1, 1) };
        let sink = Sink::new(&job);
        let (_, inlet) = sink.inlets(&job).remove(0);
        (1..=4).for_each(|number| inlet.arrive(Stamp { number, sent_ns: 0 }));
        let measured = sink.measured();
        assert_eq!((measured.messages, measured.lost, measured.times_ns.len()), (3, 0, 1));
    }

    #[test]
    fn the_last_arrival_counts_where_all_have_it() {
        let arrivals = vec![(1, 5), (2, 9), (1, 7), (2, 3), (3, 1)];
        assert_eq!(to_the_last(arrivals, 2), [(1, 7), (2, 9)]);
    }
}
