// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic hz` and `taut topic bw`: how often, how regularly and how much publishers send.
//!
//! Publishers count their messages in shared memory. Read often enough, the count shows each message separately, with its time. Messages
//! that are too fast for that, or come from other hosts, must be taken.

use super::sim_clock::SimClock;
use super::tap::{POLL, Tap, ends, wait_for_type};
use crate::arguments::full_name;
use crate::completions;
use crate::table::write_table;
use crate::times::Times;
use crate::verb::{CommonArgs, End, Failure, Outcome, time};
use clap::Args;
use indicatif::DecimalBytes;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};
use tautline_transport::{EndpointKind, Gid, GraphSnapshot, Sent, Visitor, graph_of};

/// Below this rate each message is seen separately.
const SEEN_HZ: f64 = 400.0;
/// The interval at which counts of faster publishers are read.
const FAST_POLL: Duration = Duration::from_millis(50);
/// The maximum number of messages that are taken in a row, because they may come faster than they are read.
const MOST_TAKEN: usize = 1000;
/// The time that `--expect` measures by default, after a wait of at most as long for the topic.
const EXPECT_TIME: Duration = Duration::from_secs(5);

#[derive(Args, Clone, Debug)]
pub struct RateArgs {
    /// The topic; waited for if it does not exist
    #[arg(value_name = "TOPIC", add = completions::topics())]
    topic: String,
    /// Interval between outputs
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = time)]
    every: Duration,
    /// Restart the counts after this time; --expect does not restart them
    #[arg(long, value_name = "TIME", default_value = "10s", value_parser = time)]
    window: Duration,
    /// Measure for 5 s, or --timeout; exit with 1 if the sum of all publishers is not within LOW..HIGH; either may be omitted
    #[arg(long, value_name = "LOW..HIGH", value_parser = range)]
    expect: Option<RangeInclusive<f64>>,
    /// Take every message: measures the periods of faster publishers, and counts gaps in sequence numbers
    #[arg(long)]
    take: bool,
    /// Count by the time of /clock, whose period is the resolution, instead of the system's; --every, --window and --timeout are the
    /// system's
    #[arg(long)]
    sim_time: bool,
}

/// The main unit of the output.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    Messages,
    Bytes,
}

fn range(text: &str) -> Result<RangeInclusive<f64>, String> {
    let (low, high) = text.split_once("..").ok_or("a range is LOW..HIGH, such as 95..105")?;
    let number = |text: &str, other: f64| match text {
        "" => Ok(other),
        text => text.parse::<f64>().map_err(|_| format!("'{text}' is no number")),
    };
    let (low, high) = (number(low, 0.0)?, number(high, f64::INFINITY)?);
    if low <= high { Ok(low..=high) } else { Err("LOW is above HIGH".into()) }
}

/// What one publisher has sent since its first reading.
struct Flow {
    label: String,
    pid: Option<u32>,
    /// Whether the graph had it: from then on it ends when the graph has it no more.
    is_listed: bool,
    first: Sent,
    last: Sent,
    /// Times between two messages.
    periods: Times,
    /// Messages of readings that cover several messages: their times and sizes are not known separately.
    unseen: u64,
    /// Sizes of the smallest and the largest message.
    sizes: Option<(u64, u64)>,
    /// Lost messages by gaps in sequence numbers; `None` if only counts are read.
    lost: Option<u64>,
    number: u64,
}

impl Flow {
    fn new(label: String, pid: Option<u32>, first: Sent, lost: Option<u64>) -> Self {
        let (periods, unseen, sizes, number) = (Times::default(), 0, None, 0);
        Flow { label, pid, is_listed: true, first, last: first, periods, unseen, sizes, lost, number }
    }

    /// Restarts the counts.
    fn restart(&mut self) {
        self.first = self.last;
        self.periods.clear();
        (self.unseen, self.sizes, self.lost) = (0, None, self.lost.map(|_| 0));
    }

    /// Adds a later reading of the counters.
    fn add(&mut self, sent: Sent) {
        let new = sent.messages.wrapping_sub(self.last.messages);
        if new == 0 || new > u64::MAX / 2 {
            return;
        }
        match new {
            1 => self.add_one(sent.bytes.wrapping_sub(self.last.bytes), sent.last_ns),
            _ => self.unseen += new,
        }
        if self.last.last_ns == 0 {
            // This is the first message with a known time: later ones are counted from it.
            self.first = sent;
        }
        self.last = sent;
    }

    fn add_one(&mut self, bytes: u64, at_ns: u64) {
        if self.last.last_ns != 0 {
            self.periods.record(at_ns.saturating_sub(self.last.last_ns));
        }
        let (least, most) = self.sizes.unwrap_or((bytes, bytes));
        self.sizes = Some((least.min(bytes), most.max(bytes)));
    }

    /// Adds a message that was taken.
    fn take(&mut self, number: u64, at_ns: u64, len_bytes: usize) {
        if self.number != 0 {
            let gap = number.saturating_sub(self.number + 1);
            self.lost = self.lost.map(|lost| lost + gap);
        }
        self.number = number;
        let Sent { messages, bytes, .. } = self.last;
        self.add(Sent { messages: messages + 1, bytes: bytes + len_bytes as u64, last_ns: at_ns });
    }

    /// The number of messages from which the rate is computed.
    fn messages(&self) -> u64 {
        self.last.messages.wrapping_sub(self.first.messages)
    }

    /// The time from the first message to the last one; until now for a publisher that has fallen silent.
    fn seconds(&self, now_ns: u64) -> f64 {
        let span = self.last.last_ns.saturating_sub(self.first.last_ns);
        let silence = now_ns.saturating_sub(self.last.last_ns);
        let period = span / self.messages().max(1);
        let is_silent = self.messages() > 0 && silence > period.max(10_000_000).saturating_mul(3);
        (span + if is_silent { silence - period } else { 0 }) as f64 / 1e9
    }

    fn rate(&self, of: u64, now_ns: u64) -> f64 {
        match self.seconds(now_ns) {
            0.0 => 0.0,
            seconds => of as f64 / seconds,
        }
    }

    fn hz(&self, now_ns: u64) -> f64 {
        self.rate(self.messages(), now_ns)
    }

    fn bytes_per_second(&self, now_ns: u64) -> f64 {
        self.rate(self.last.bytes.wrapping_sub(self.first.bytes), now_ns)
    }

    fn mean_bytes(&self) -> Option<u64> {
        self.last.bytes.wrapping_sub(self.first.bytes).checked_div(self.messages())
    }

    /// The periods, if nearly all are known.
    fn known_periods(&self) -> Option<&Times> {
        Some(&self.periods).filter(|times| times.count() > 0 && self.unseen * 100 <= self.messages())
    }
}

/// Where messages are counted.
enum Source {
    Counts(Visitor),
    Messages(Tap),
}

/// All publishers of a topic.
struct Meter {
    domain: u32,
    topic: String,
    source: Source,
    /// The clock by which messages are counted; `None`: the system's.
    sim_clock: Option<SimClock>,
    flows: BTreeMap<Gid, Flow>,
    /// Messages that were overwritten before they were taken here, until the counts were restarted.
    missed_before: u64,
}

/// Forgets publishers that have ended, unless all have: if their process was restarted, their rates would be added to those of its new
/// publishers.
fn forget_ended(flows: &mut BTreeMap<Gid, Flow>, there: &BTreeSet<Gid>) {
    let is_there = |gid: &Gid, flow: &Flow| !flow.is_listed || there.contains(gid);
    flows.iter_mut().for_each(|(gid, flow)| flow.is_listed |= there.contains(gid));
    if flows.iter().any(|(gid, flow)| is_there(gid, flow)) {
        flows.retain(|gid, flow| is_there(gid, flow));
    }
}

impl Meter {
    fn start(domain: u32, topic: &str, args: &RateArgs, end: &End) -> Outcome<Self> {
        let topic_type = wait_for_type(domain, topic, end)?;
        let mut visitor = Visitor::new(domain)?;
        let is_elsewhere = is_elsewhere(&*visitor.graph()?, topic);
        let source = match args.take || is_elsewhere {
            true => Source::Messages(Tap::open(domain, topic, topic_type)?),
            false => Source::Counts(visitor),
        };
        let mut sim_clock = if args.sim_time { Some(SimClock::new(domain)?) } else { None };
        if let Some(clock) = &mut sim_clock {
            clock.wait(end)?;
        }
        let (topic, flows) = (topic.to_owned(), BTreeMap::new());
        Ok(Meter { domain, topic, source, sim_clock, flows, missed_before: 0 })
    }

    /// Reads counts or takes messages. Returns the time until the next update.
    fn update(&mut self) -> Outcome<Duration> {
        let (topic, flows) = (&self.topic, &mut self.flows);
        if let Some(clock) = &mut self.sim_clock
            && clock.poll()?
        {
            eprintln!("taut: /clock jumped back: counting starts anew");
            flows.clear();
        }
        match &mut self.source {
            Source::Counts(visitor) => {
                let graph = visitor.graph()?;
                if is_elsewhere(&graph, topic)
                    && let Some(first) = ends(&graph, topic).next()
                {
                    // A publisher on another host has appeared, whose messages must be taken to be counted.
                    flows.clear();
                    self.source = Source::Messages(Tap::open(self.domain, topic, first.topic_type.clone())?);
                    return Ok(Duration::ZERO);
                }
                for end in ends(&graph, topic).filter(|end| end.kind == EndpointKind::Publisher) {
                    let Some(mut sent) = visitor.sent(end)? else { continue };
                    if let Some(clock) = &self.sim_clock {
                        // The time of a message before /clock is not known: 0, as before the first message.
                        sent.last_ns = clock.at_monotonic(sent.last_ns).unwrap_or(0);
                    }
                    let flow = flows.entry(end.gid);
                    flow.or_insert_with(|| Flow::new(label(&graph, topic, end.gid), end.pid, sent, None))
                        .add(sent);
                }
                let now_ns = tautline_rt::clock::monotonic_ns();
                let is_fast = |flow: &Flow| flow.messages() > 100 && flow.hz(now_ns) > SEEN_HZ;
                let is_fast = self.sim_clock.is_none() && flows.values().any(is_fast);
                Ok(if is_fast { FAST_POLL } else { POLL })
            }
            Source::Messages(tap) => {
                for _ in 0..MOST_TAKEN {
                    let Some(sample) = tap.take()? else { return Ok(POLL) };
                    let info = sample.info();
                    let flow = flows.entry(info.publisher_gid).or_insert_with(|| {
                        let graph = graph_of(self.domain).unwrap_or_default();
                        let end = ends(&graph, topic).find(|end| end.gid == info.publisher_gid);
                        let (is_listed, pid) = (end.is_some(), end.and_then(|end| end.pid));
                        let label = label(&graph, topic, info.publisher_gid);
                        Flow { is_listed, ..Flow::new(label, pid, Sent::default(), Some(0)) }
                    });
                    let mut at_ns = u64::try_from(info.source_timestamp_ns).unwrap_or(0);
                    if let Some(clock) = &self.sim_clock {
                        at_ns = clock.at_wall(at_ns).unwrap_or(0);
                    }
                    flow.take(info.sequence_number, at_ns, sample.body().len());
                }
                Ok(Duration::ZERO)
            }
        }
    }

    fn forget_ended(&mut self) -> Outcome {
        let graph = graph_of(self.domain)?;
        forget_ended(&mut self.flows, &ends(&graph, &self.topic).map(|end| end.gid).collect());
        Ok(())
    }

    /// Restarts the counts.
    fn restart(&mut self) {
        self.missed_before += self.missed();
        self.flows.values_mut().for_each(Flow::restart);
    }

    /// Messages that were overwritten before they were taken here.
    fn missed(&self) -> u64 {
        match &self.source {
            Source::Counts(_) => 0,
            Source::Messages(tap) => tap.lost() - self.missed_before,
        }
    }

    /// Now, by the clock of the flows.
    fn now_ns(&self) -> u64 {
        match (&self.sim_clock, &self.source) {
            (Some(clock), _) => clock.now_ns(),
            (None, Source::Counts(_)) => tautline_rt::clock::monotonic_ns(),
            (None, Source::Messages(_)) => u64::try_from(tautline_rt::clock::wall_ns()).unwrap_or(0),
        }
    }

    /// The rate of all flows.
    fn sum(&self, rate: impl Fn(&Flow, u64) -> f64) -> f64 {
        let now_ns = self.now_ns();
        self.flows.values().map(|flow| rate(flow, now_ns)).sum()
    }

    fn to_json(&self, since: Instant) -> Value {
        let now_ns = self.now_ns();
        let flow = |(gid, flow): (&Gid, &Flow)| {
            json!({
                "publisher": flow.label,
                "pid": flow.pid,
                "gid": format!("{gid:?}"),
                "messages": flow.messages(),
                "rate_hz": flow.hz(now_ns),
                "period_ms": flow.known_periods().map(Times::to_json),
                "bytes_per_s": flow.bytes_per_second(now_ns),
                "mean_bytes": flow.mean_bytes(),
                "lost": flow.lost,
            })
        };
        json!({
            "topic": self.topic,
            "seconds": since.elapsed().as_secs_f64(),
            "sim_time": self.sim_clock.is_some(),
            "from": match self.source { Source::Counts(_) => "counts", Source::Messages(_) => "messages" },
            "rate_hz": self.sum(Flow::hz),
            "bytes_per_s": self.sum(Flow::bytes_per_second),
            "missed_here": self.missed(),
            "publishers": self.flows.iter().map(flow).collect::<Value>(),
        })
    }

    fn print(&self, unit: Unit, out: &mut impl Write) -> io::Result<()> {
        let now_ns = self.now_ns();
        let row = |flow: &Flow| {
            let rate = format!("{:.3}", flow.hz(now_ns));
            let bytes = format!("{}/s", DecimalBytes(flow.bytes_per_second(now_ns) as u64));
            let mean = flow.mean_bytes().map_or("-".into(), |mean| DecimalBytes(mean).to_string());
            let n = flow.messages().to_string();
            let lost = flow.lost.map_or("-".into(), |lost| lost.to_string());
            let label = flow.label.clone();
            let cells = match unit {
                Unit::Messages => {
                    let [p50, p99, max] =
                        flow.known_periods().map_or_else(|| ["-"; 3].map(String::from), Times::cells);
                    vec![label, rate, p50, p99, max, bytes, n, lost]
                }
                Unit::Bytes => {
                    let sizes = flow.sizes.filter(|_| flow.unseen == 0).map(<[u64; 2]>::from);
                    let [least, most] = match sizes {
                        Some(sizes) => sizes.map(|bytes| DecimalBytes(bytes).to_string()),
                        None => ["-", "-"].map(String::from),
                    };
                    vec![label, bytes, mean, least, most, rate, n, lost]
                }
            };
            (true, cells)
        };
        let head: &[&str] = match unit {
            Unit::Messages => &["publisher", "Hz", "p50 ms", "p99 ms", "max ms", "bytes", "n", "lost"],
            Unit::Bytes => &["publisher", "bytes", "mean", "least", "most", "Hz", "n", "lost"],
        };
        write_table(head, 1, self.flows.values().map(row).collect(), out)
    }

    /// How the numbers were measured.
    fn explain(&self) -> String {
        match &self.source {
            Source::Counts(_) => {
                let is_fast =
                    self.flows.values().any(|flow| flow.messages() > 0 && flow.known_periods().is_none());
                let hint = if is_fast { "; too fast for periods: --take measures them" } else { "" };
                format!("(from the publishers' own counts{hint})")
            }
            Source::Messages(tap) => {
                let lost = match self.missed() {
                    0 => String::new(),
                    lost => {
                        format!("; {lost} of the lost messages were overwritten before they were taken here")
                    }
                };
                let seen = if tap.is_seen() { ", which others see as a subscription" } else { "" };
                format!("(from every message{seen}{lost})")
            }
        }
    }
}

/// The node's full name, followed by the GID if the node has several publishers of the topic; without a node, the GID.
fn label(graph: &GraphSnapshot, topic: &str, gid: Gid) -> String {
    let end = ends(graph, topic).find(|end| end.gid == gid);
    let node = end.and_then(|end| end.node.as_ref()).map(|node| node.full_name());
    let same = ends(graph, topic).filter(|other| {
        other.kind == EndpointKind::Publisher && other.node.as_ref().map(|node| node.full_name()) == node
    });
    let is_one = same.count() < 2;
    match (node, is_one) {
        (Some(node), true) => node,
        (Some(node), false) => format!("{node} {gid:?}"),
        (None, _) => format!("{gid:?}"),
    }
}

fn is_elsewhere(graph: &GraphSnapshot, topic: &str) -> bool {
    ends(graph, topic).any(|end| end.is_remote && end.kind == EndpointKind::Publisher)
}

pub fn run(args: &RateArgs, unit: Unit, common: &CommonArgs) -> Outcome {
    let mut end = if args.expect.is_some() { End::within(EXPECT_TIME, common)? } else { End::of(common)? };
    let (domain, topic) = (common.domain()?, full_name(&args.topic));
    let mut meter = Meter::start(domain, &topic, args, &end)?;
    let mut unused_clock = if args.sim_time { None } else { Some(SimClock::new(domain)?) };
    if args.expect.is_some() {
        end.restart();
    }
    let mut since = Instant::now();
    let mut next = since + args.every;
    loop {
        let pause = meter.update()?;
        if let Some(clock) = &mut unused_clock {
            clock.poll()?;
            clock.warn(false);
        }
        let is_last = end.is_reached();
        if is_last || Instant::now() >= next {
            next += args.every;
            meter.forget_ended()?;
            let mut out = crate::print::stdout();
            if common.json {
                writeln!(out, "{}", meter.to_json(since))?;
            } else if meter.flows.is_empty() {
                end.print_waiting_once(|| format!("a publisher of '{topic}'"));
            } else {
                meter.print(unit, &mut out)?;
                writeln!(out, "{}\n", meter.explain())?;
            }
            out.flush()?;
            if args.expect.is_none() && since.elapsed() >= args.window {
                since = Instant::now();
                meter.restart();
            }
        }
        if is_last {
            break;
        }
        end.pause(pause);
    }
    let Some(expected) = &args.expect else { return Ok(()) };
    let (found, what) = match unit {
        Unit::Messages => (meter.sum(Flow::hz), "messages a second"),
        Unit::Bytes => (meter.sum(Flow::bytes_per_second), "bytes a second"),
    };
    match expected.contains(&found) {
        true => Ok(()),
        false => Err(Failure::no(format!(
            "'{topic}': {found:.3} {what}, which is not within {}..{}",
            expected.start(),
            expected.end()
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sent(messages: u64, bytes: u64, last_ns: u64) -> Sent {
        Sent { messages, bytes, last_ns }
    }

    #[test]
    fn a_rate_is_of_messages_between_the_first_and_the_last() {
        let mut flow = Flow::new("x".into(), None, sent(7, 700, 1_000_000_000), None);
        for n in 1..=10 {
            flow.add(sent(7 + n, 700 + 50 * n, 1_000_000_000 + n * 100_000_000));
        }
        let now_ns = 2_050_000_000;
        assert!((flow.hz(now_ns) - 10.0).abs() < 1e-9);
        assert!((flow.bytes_per_second(now_ns) - 500.0).abs() < 1e-9);
        assert_eq!((flow.mean_bytes(), flow.sizes), (Some(50), Some((50, 50))));
        let all = flow.known_periods().unwrap().ms().unwrap();
        assert!(all.iter().all(|ms| (ms - 100.0).abs() <= 0.1), "{all:?}");
        // Of one that has fallen silent the rate falls.
        assert!(flow.hz(11_900_000_000) < 1.0);
    }

    #[test]
    fn what_is_too_fast_has_a_rate_and_no_periods() {
        let mut flow = Flow::new("x".into(), None, Sent::default(), None);
        flow.add(sent(1, 10, 5_000_000_000));
        for n in 1..=10 {
            flow.add(sent(1 + 50 * n, 10 + 500 * n, 5_000_000_000 + n * 1_000_000));
        }
        assert!((flow.hz(5_010_000_001) - 50_000.0).abs() < 1e-6);
        assert!(flow.known_periods().is_none());
    }

    #[test]
    fn ranges_are_read() {
        assert_eq!(range("95..105"), Ok(95.0..=105.0));
        assert_eq!(range("..5"), Ok(0.0..=5.0));
        assert_eq!(range("1.5.."), Ok(1.5..=f64::INFINITY));
        for wrong in ["5", "a..b", "9..1"] {
            assert!(range(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn gaps_in_numbers_are_lost() {
        let mut flow = Flow::new("x".into(), None, Sent::default(), Some(0));
        for number in [3, 4, 7, 8] {
            flow.take(number, 1_000 * number, 100);
        }
        assert_eq!((flow.lost, flow.messages()), (Some(2), 3));
    }

    #[test]
    fn publishers_of_other_hosts_that_have_ended_are_forgotten_too() {
        let gid = |byte| Gid([byte; 16]);
        // One of them, 3, the graph has not had yet: its messages came before it.
        let flow = |byte| {
            let flow = Flow::new("x".into(), None, Sent::default(), Some(0));
            (gid(byte), Flow { is_listed: byte != 3, ..flow })
        };
        let mut flows = BTreeMap::from([1, 2, 3].map(flow));
        let mut left = |there: &[u8]| {
            forget_ended(&mut flows, &there.iter().map(|byte| gid(*byte)).collect());
            flows.keys().map(|gid| gid.0[0]).collect::<Vec<_>>()
        };
        assert_eq!(left(&[2]), [2, 3]);
        assert_eq!(left(&[2, 3]), [2, 3]);
        assert_eq!(left(&[2]), [2]);
        assert_eq!(left(&[]), [2], "the last rates stay");
    }
}
