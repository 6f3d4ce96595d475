// SPDX-License-Identifier: MIT OR Apache-2.0
//! Many topics between two processes: what publishing costs as they grow in number, and what making and looking at them does.

use crate::job::{DOMAIN, Job, Said, wait_until};
use crate::population::{PATIENCE, made, memory_of, time_looks, times};
use crate::process;
use crate::stopwatch::Stopwatch;
use crate::{Bench, Experiment, Result};
use std::thread::sleep;
use std::time::Duration;
use tautline::std_msgs::msg::UInt64;
use tautline_exchange::say;
use tautline_harness::readings::Reading;
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{Limits, Participant, Publisher, Qos};

/// Topics that are published on, however many there are.
const BUSY: usize = 10;
const ON_BUSY: &str = "publishing on 10 of them";
const ON_ALL: &str = "publishing on each in turn (caches are cold)";

pub fn measure(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let mut rows = Vec::new();
    let mut least: Option<f64> = None;
    for &topics in &bench.topics {
        let row = |what: &str, unit| Reading::of(Experiment::Topics, topics, what, unit);
        let mut listener = bench.start(&Job::Listen { topics })?;
        made(&mut listener)?;
        let subscriptions = times(&mut listener)?;
        let mut talker = bench.start(&Job::Talk { topics, quick: bench.quick })?;
        let all_made = made(&mut talker)?;
        rows.push(row("making all publishers and matching them", "ms").value(all_made as f64 / 1e6));
        for (what, times) in times(&mut talker)?.into_iter().chain(subscriptions) {
            rows.push(row(&what, "µs").times(&times));
            if what == ON_BUSY {
                let now = times.quantile_us(0.5);
                let ratio = now / *least.get_or_insert(now);
                rows.push(row("the same, to that at the fewest topics", "x").value(ratio).at_most(1.2));
            }
        }
        let pids = [listener.id(), talker.id()];
        rows.extend(memory_of(Experiment::Topics, topics, &pids));
        for (pid, what) in pids.into_iter().zip(["subscribing", "publishing"]) {
            let count = |what: &str, unit, count: usize| row(what, unit).value(count as f64);
            let descriptors = process::descriptors(pid).len();
            rows.push(count(&format!("descriptors of the {what} process"), "files", descriptors));
            let mappings = process::mappings(pid);
            rows.push(count(&format!("parts of the {what} process's address space"), "mappings", mappings));
        }
        talker.finish()?;
        listener.finish()?;
    }
    Ok(rows)
}

fn name(topic: usize) -> String {
    format!("/topics/topic_{topic}")
}

pub fn listen(topics: usize) -> Result<()> {
    let participant = Participant::new(DOMAIN)?;
    let mut times = Stopwatch::default();
    let mut subscriptions = Vec::new();
    let begin_ns = monotonic_ns();
    for topic in 0..topics {
        let name = name(topic);
        let subscription =
            || participant.create_subscription::<UInt64>(&name, Qos::default(), Limits::default());
        subscriptions.push(times.time("making a subscription", subscription)?);
    }
    say(&Said::Made { ns: monotonic_ns() - begin_ns });
    times.say_and_stay()
}

pub fn talk(topics: usize, quick: bool) -> Result<()> {
    let participant = Participant::new(DOMAIN)?;
    let mut times = Stopwatch::default();
    let mut publishers: Vec<Publisher<UInt64>> = Vec::new();
    let begin_ns = monotonic_ns();
    for topic in 0..topics {
        let name = name(topic);
        let publisher = || participant.create_publisher(&name, Qos::default(), Limits::default());
        publishers.push(times.time("making a publisher that another process listens to", publisher)?);
    }
    wait_until(
        "all publishers are matched",
        PATIENCE,
        || sleep(Duration::from_millis(1)),
        || Ok(publishers.iter().all(|publisher| publisher.subscription_count() == 1)),
    )?;
    say(&Said::Made { ns: monotonic_ns() - begin_ns });
    // Until the other process's janitor is done.
    sleep(Duration::from_millis(500));
    let rounds = if quick { 20_000 } else { 100_000 };
    // Spread over all, and the same topics in every round.
    let busy: Vec<_> = publishers.iter().step_by(topics.div_ceil(BUSY)).collect();
    publish(&mut times, ON_BUSY, rounds, &busy)?;
    let each: Vec<_> = publishers.iter().collect();
    publish(&mut times, ON_ALL, (rounds * BUSY).div_ceil(topics).max(3), &each)?;
    time_looks(&mut times, quick)?;
    times.say_and_stay()
}

/// Notes the time of each of so many rounds, for one message.
fn publish(
    times: &mut Stopwatch,
    what: &str,
    rounds: usize,
    publishers: &[&Publisher<UInt64>],
) -> Result<()> {
    for round in 0..rounds {
        // Ten at a time: the clock's own cost is a tenth.
        for publishers in publishers.chunks(BUSY) {
            let start_ns = monotonic_ns();
            for publisher in publishers {
                publisher.publish(&UInt64 { data: round as u64 })?;
            }
            let time_ns = (monotonic_ns() - start_ns) / publishers.len() as u64;
            // The first rounds bring in what was never used.
            if round >= rounds / 10 {
                times.note(what, time_ns);
            }
        }
    }
    Ok(())
}
