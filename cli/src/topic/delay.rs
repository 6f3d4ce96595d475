// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic delay`: the ages of messages at their publication, and the time until they are taken.

use super::sim_clock::SimClock;
use super::tap::{OtherTypes, POLL, ends, wait_for_type};
use crate::arguments::full_name;
use crate::compatibility::label;
use crate::completions;
use crate::table::write_table;
use crate::times::Times;
use crate::verb::{CommonArgs, End, Failure, Outcome, time};
use clap::Args;
use serde_json::{Value as Json, json};
use std::collections::BTreeMap;
use std::io::Write;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline_definitions::find_schema;
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_rt::{Policy, set_policy};
use tautline_schema::{DynamicMessage, Endian, Schema};
use tautline_transport::{Gid, Limits, Participant, Qos, TakeError, TopicType};

/// Prints the time from each message's stamp to its publication, and from there until it is taken here
///
/// Subscribes as a node does: publishers wake this command for each message. The stamp is the field header.stamp, or stamp, by the
/// system's clock, or with --sim-time by /clock.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut topic delay /scan
  taut topic delay /scan --priority 80         taken by a thread with SCHED_FIFO
  taut topic delay /scan --max 5ms --timeout 10s   exits with 1 if a message was taken later")]
pub struct DelayArgs {
    /// The topic; waited for if it does not exist
    #[arg(value_name = "TOPIC", add = completions::topics())]
    topic: String,
    /// Interval between outputs
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = time)]
    every: Duration,
    /// Take with this priority of SCHED_FIFO
    #[arg(long, value_name = "1..99", value_parser = clap::value_parser!(u8).range(1..=99))]
    priority: Option<u8>,
    /// Exit with 1 if a message was taken later than this after its publication
    #[arg(long, value_name = "TIME", value_parser = time)]
    max: Option<Duration>,
    /// Compare stamps with the time of /clock, whose period is the resolution
    #[arg(long)]
    sim_time: bool,
}

/// The delays of one publisher's messages.
#[derive(Default)]
struct Ages {
    label: String,
    /// Times from the stamp, of messages that have one, to the publication.
    published: Times,
    /// Times from the publication on this host until the message was taken.
    taken: Times,
    /// The number of stamps that are later than the publication.
    ahead: u64,
}

impl Ages {
    fn to_json(&self) -> Json {
        json!({
            "publisher": self.label,
            "messages": self.taken.count(),
            "stamp_to_publish_ms": self.published.to_json(),
            "publish_to_take_ms": self.taken.to_json(),
            "stamps_ahead": self.ahead,
        })
    }

    fn row(&self) -> Vec<String> {
        let n = self.taken.count().to_string();
        [vec![self.label.clone()], self.published.cells().into(), self.taken.cells().into(), vec![n]].concat()
    }
}

/// What the table does not contain: messages that were overwritten before they were taken, messages that are not valid, and stamps that
/// are later than the publication.
fn remarks(numbers: [u64; 3]) -> impl Iterator<Item = String> {
    let words = [
        "messages were overwritten before they were taken, and have no delay",
        "messages are not valid ones of the type, and have no delay",
        "stamps are later than the publication, and have no age: do their clocks differ?",
    ];
    let some = numbers.into_iter().zip(words).filter(|(number, _)| *number > 0);
    some.map(|(number, words)| format!("({number} {words})"))
}

/// The stamp of a message, in ns since 1970.
fn stamp_of(schema: &Arc<Schema>, body: &[u8]) -> Option<i64> {
    let message = DynamicMessage::from_body(schema, body, Endian::Little).ok()?;
    let number =
        |path: &str| message.get(path).ok()?.as_integer().and_then(|number| i64::try_from(number).ok());
    let at = |path: &str| {
        let (sec, nanosec) = (number(&format!("{path}.sec"))?, number(&format!("{path}.nanosec"))?);
        Some(sec.saturating_mul(1_000_000_000).saturating_add(nanosec))
    };
    at("header.stamp").or_else(|| at("stamp"))
}

pub fn run(args: &DelayArgs, common: &CommonArgs) -> Outcome {
    let end = End::of(common)?;
    let (domain, topic) = (common.domain()?, full_name(&args.topic));
    let topic_type = wait_for_type(domain, &topic, &end)?;
    let participant = Participant::new(domain)?;
    // As `ros2 topic delay`: compatible with every publisher, also with those that come later. What is kept is old, and no delay.
    let qos = Qos::keep_last(100).best_effort();
    let node = participant.create_node(&format!("taut_delay_{}", std::process::id()), "/")?;
    let topic_type = TopicType { definition: None, body_bytes: None, ..topic_type };
    let limits = Limits { held: 1, ..Limits::default() };
    let subscription =
        participant.for_node(&node).create_raw_subscription(&topic, &topic_type, qos, limits)?;
    // Without the definition, only the time through this host is measured.
    let schema =
        topic_type.name.parse().ok().and_then(|name| find_schema(&topic, &name, Some(&topic_type)).ok());
    if schema.is_none() {
        eprintln!("taut: the definition of {} is not known: its stamps cannot be read", topic_type.name);
    }
    let mut clock = SimClock::new(domain)?;
    if args.sim_time {
        clock.wait(&end)?;
    }
    let seat = participant.doorbell().claim_sampler()?;
    if let Some(priority) = args.priority {
        set_policy(Policy::Fifo(priority))?;
    }
    let (mut all, mut other_types) = (BTreeMap::<Gid, Ages>::new(), OtherTypes::default());
    let mut next = Instant::now() + args.every;
    loop {
        seat.drain(|_| {});
        clock.poll()?;
        if !args.sim_time {
            clock.warn(true);
        }
        // Messages may come faster than they are read.
        let begun = Instant::now();
        while begun.elapsed() < args.every.max(POLL) && !end.is_reached() {
            let sample = match subscription.try_take() {
                Ok(Some(sample)) => sample,
                Ok(None) => break,
                Err(TakeError::Invalid(_)) => continue,
                Err(error) => return Err(error.into()),
            };
            let (now_ns, info) = (monotonic_ns(), sample.info());
            let ages = all.entry(info.publisher_gid).or_insert_with(|| {
                let graph = participant.graph().unwrap_or_default();
                let end = ends(&graph, &topic).find(|end| end.gid == info.publisher_gid);
                let label = end.map_or_else(|| format!("{:?}", info.publisher_gid), |end| label(end));
                Ages { label, ..Ages::default() }
            });
            ages.taken.record(now_ns.saturating_sub(info.released_ns));
            let published_ns = match args.sim_time {
                true => clock.at_monotonic(info.released_ns).and_then(|ns| i64::try_from(ns).ok()),
                false => Some(info.source_timestamp_ns),
            };
            let stamp = schema.as_ref().and_then(|schema| stamp_of(schema, sample.body()));
            if let Some((published_ns, stamp)) = published_ns.zip(stamp) {
                match u64::try_from(published_ns.saturating_sub(stamp)) {
                    Ok(age_ns) => ages.published.record(age_ns),
                    Err(_) => ages.ahead += 1,
                }
            }
        }
        let is_last = end.is_reached();
        if is_last || Instant::now() >= next {
            next += args.every;
            other_types.print_new(&*participant.graph()?, &topic, &topic_type);
            let mut out = crate::print::stdout();
            if common.json {
                let ages: Json = all.values().map(Ages::to_json).collect();
                writeln!(
                    out,
                    "{}",
                    json!({
                        "topic": topic, "sim_time": args.sim_time, "publishers": ages,
                        "lost": subscription.counters().lost(),
                    })
                )?;
            } else if all.is_empty() {
                end.print_waiting_once(|| format!("a message on '{topic}'"));
            } else {
                let head =
                    ["publisher", "stamp-pub p50 ms", "p99", "max", "pub-take p50 ms", "p99", "max", "n"];
                write_table(&head, 1, all.values().map(|ages| (true, ages.row())).collect(), &mut out)?;
                let counters = subscription.counters();
                let ahead = all.values().map(|ages| ages.ahead).sum();
                for remark in remarks([counters.lost(), counters.invalid(), ahead]) {
                    writeln!(out, "{remark}")?;
                }
                writeln!(out)?;
            }
            out.flush()?;
        }
        if is_last {
            break;
        }
        // The maximum time until a signal is handled; messages of /clock wake no observer.
        let patience = if args.sim_time { POLL } else { Duration::from_millis(50) };
        let patience = patience.min(end.left().unwrap_or(Duration::MAX));
        seat.sleep(Some(monotonic_ns() + nanoseconds(patience)));
    }
    let Some(max) = args.max else { return Ok(()) };
    match all.values().map(|ages| Duration::from_nanos(ages.taken.max_ns())).max() {
        None => Err(Failure::no(format!("no message came on '{topic}'"))),
        Some(longest) if longest > max => Err(Failure::no(format!(
            "'{topic}': a message was taken {longest:?} after its publication, not {max:?}"
        ))),
        Some(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_no_delay_is_counted_below_the_table() {
        assert_eq!(remarks([0; 3]).count(), 0);
        let said: Vec<_> = remarks([7, 0, 3]).collect();
        assert!(said.len() == 2 && said[0].starts_with("(7 messages were overwritten"), "{said:?}");
        assert!(said[1].starts_with("(3 stamps are later"), "{said:?}");
    }
}
