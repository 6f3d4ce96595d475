// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does a publisher notice that somebody looks?
//!
//! A thread publishes at 1 kHz, with a real-time priority if it may have one, and times each publication, while nobody looks and
//! while `taut` does, in alternating rounds. What the kernel counts for the thread says more than times do: page faults, and how
//! often it lost its core. What a recorder adds to p99.9 is judged in `recording`, where there are enough publications for that:
//! here two equal cases differ by more. That an observer costs no system call is a test (`transport/tests/syscalls.rs`).

use crate::{DOMAIN, Looking, Result, Taut};
use hdrhistogram::Histogram;
use serde::Serialize;
use std::error::Error;
use std::time::Duration;
use tautline::geometry_msgs::msg::Point;
use tautline_benches::rows;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_rt::{CoreSet, MemoryLock, Policy, lock_memory, set_affinity, set_policy};
use tautline_transport::{Limits, Participant, Publisher, Qos, Subscription};

const PERIOD_NS: u64 = 1_000_000;

/// Stands for the cores that the publishing thread is not on.
const OTHERS: &str = "OTHERS";
/// Who looks, and whether that should cost nothing.
const CASES: [(&str, &[&str], bool); 8] = [
    ("nobody", &[], true),
    // What a ratio of two equal things is here.
    ("nobody, again", &[], true),
    ("taut topic hz", &["topic", "hz", "/looked_at"], true),
    ("taut top", &["top", "--json", "--every", "200ms"], true),
    ("taut record", &["record", "/looked_at"], true),
    ("taut record --cores", &["record", "/looked_at", "--cores", OTHERS], true),
    ("taut topic hz --take", &["topic", "hz", "/looked_at", "--take"], false),
    ("taut topic echo", &["topic", "echo", "/looked_at"], false),
];

#[derive(Serialize)]
pub struct Case {
    name: &'static str,
    messages: u64,
    p50_us: f64,
    p99_us: f64,
    /// Of a round, the median of all: one stall of the host is in the maximum only.
    p999_us: f64,
    max_us: f64,
    /// Of the publishing thread, in all rounds.
    page_faults: u64,
    /// How often it lost its core.
    preempted: u64,
    /// Rounds in which there were page faults. What looking costs comes in each; what the kernel moves about does not.
    faulted_rounds: u64,
}

/// Times, and the p99.9 of each round; page faults and how often the core was lost; rounds with page faults.
type Counted = ((Histogram<u64>, Vec<u64>), [u64; 2], u64);

/// Page faults and involuntary changes of the thread on the core, so far.
fn counted() -> Result<[u64; 2]> {
    let text = std::fs::read_to_string("/proc/thread-self/stat")?;
    let faults =
        text.rsplit(") ").next().and_then(|rest| rest.split(' ').nth(7)).ok_or("no page faults in stat")?;
    let status = std::fs::read_to_string("/proc/thread-self/status")?;
    let lost = status.lines().find_map(|line| line.strip_prefix("nonvoluntary_ctxt_switches:"));
    Ok([faults.parse()?, lost.ok_or("no switches in status")?.trim().parse()?])
}

/// Publishes for one round; the subscription is there to have somebody to send to.
fn round(
    publisher: &Publisher<Point>,
    subscription: &Subscription<Point>,
    messages: u64,
    times: &mut Histogram<u64>,
) {
    let start_ns = monotonic_ns();
    for n in 0..messages {
        sleep_until_monotonic(start_ns + n * PERIOD_NS);
        let before_ns = monotonic_ns();
        if let Ok(mut loan) = publisher.loan() {
            loan.x = n as f64;
            let _ = loan.publish();
        }
        times.saturating_record(monotonic_ns() - before_ns);
        while let Ok(Some(_)) = subscription.try_take() {}
    }
}

/// Prints the cases; the second value is what does not hold.
pub fn measure(taut: &Taut, quick: bool) -> Result<(Vec<Case>, Vec<String>)> {
    let (rounds, messages) = if quick { (2, 500) } else { (10, 3000) };
    let taut = taut.clone();
    let participant = Participant::new(DOMAIN)?;
    let publisher = participant.create_publisher::<Point>("/looked_at", Qos::default(), Limits::default())?;
    let subscription =
        participant.create_subscription::<Point>("/looked_at", Qos::default(), Limits::default())?;
    subscription.set_quiet(true);
    let cores: Vec<_> = CoreSet::allowed()?.iter().map(|core| core.to_string()).collect();
    // On a machine of one core they are on it.
    let others = cores[..cores.len().saturating_sub(1).max(1)].join(",");
    let mut all = Vec::new();
    for _ in CASES {
        all.push(((Histogram::new_with_bounds(1, 1_000_000_000, 3)?, Vec::new()), [0, 0], 0));
    }
    // As in processes with real-time threads.
    if let Err(error) = lock_memory(MemoryLock::OnFault) {
        println!("memory is not locked: {error}");
    }
    let worker = std::thread::spawn(move || -> std::result::Result<_, String> {
        let refuse = |error: Box<dyn Error>| error.to_string();
        if let Some(core) = CoreSet::allowed().ok().and_then(|cores| cores.iter().last()) {
            set_affinity(CoreSet::one(core)).map_err(|error| refuse(error.into()))?;
        }
        if let Err(error) = set_policy(Policy::Fifo(80)) {
            println!("without a real-time priority: {error}");
        }
        // Pages and caches are there.
        round(&publisher, &subscription, 200, &mut Histogram::new(3).map_err(|error| refuse(error.into()))?);
        for _ in 0..rounds {
            for ((_, arguments, _), ((times, tails), counts, faulted)) in CASES.iter().zip(&mut all) {
                let looking = match arguments.is_empty() {
                    true => None,
                    false => {
                        let argument = |argument: &&str| match *argument {
                            OTHERS => others.clone(),
                            other => other.to_owned(),
                        };
                        let arguments: Vec<_> = arguments.iter().map(argument).collect();
                        Some(Looking::start(&taut, &arguments).map_err(refuse)?)
                    }
                };
                // It has begun to look, and who is taken from has been set up for it.
                std::thread::sleep(Duration::from_millis(400));
                round(
                    &publisher,
                    &subscription,
                    100,
                    &mut Histogram::new(3).map_err(|error| refuse(error.into()))?,
                );
                let before = counted().map_err(refuse)?;
                let mut of_round =
                    Histogram::new_with_bounds(1, 1_000_000_000, 3).map_err(|error| refuse(error.into()))?;
                round(&publisher, &subscription, messages, &mut of_round);
                let after = counted().map_err(refuse)?;
                times.add(&of_round).map_err(|error| refuse(error.into()))?;
                tails.push(of_round.value_at_quantile(0.999));
                for (count, (after, before)) in counts.iter_mut().zip(after.into_iter().zip(before)) {
                    *count += after - before;
                }
                *faulted += u64::from(after[0] > before[0]);
                drop(looking);
            }
        }
        Ok(all)
    });
    let all = worker.join().map_err(|_| "the publishing thread panicked")??;
    let case = |((name, ..), ((times, tails), [page_faults, preempted], faulted_rounds)): (
        &(&'static str, _, _),
        &Counted,
    )| {
        let us = |q: f64| times.value_at_quantile(q) as f64 / 1e3;
        let (messages, max_us) = (times.len(), times.max() as f64 / 1e3);
        let (page_faults, preempted, faulted_rounds) = (*page_faults, *preempted, *faulted_rounds);
        Case {
            name,
            messages,
            p50_us: us(0.5),
            p99_us: us(0.99),
            p999_us: rows::median(tails.iter().map(|&ns| ns as f64).collect()).unwrap_or(0.0) / 1e3,
            max_us,
            page_faults,
            preempted,
            faulted_rounds,
        }
    };
    let cases: Vec<Case> = CASES.iter().zip(&all).map(case).collect();
    print(&cases);
    let faulted =
        cases.iter().zip(CASES).filter(|(case, (.., is_free))| *is_free && case.faulted_rounds == rounds);
    let fault = |case: &Case| {
        format!("{}: {} page faults of the publisher, some in every round", case.name, case.page_faults)
    };
    let broken = faulted.map(|(case, _)| fault(case)).collect();
    Ok((cases, broken))
}

fn print(cases: &[Case]) {
    println!("a publication at 1 kHz, in us, and what the kernel counts of its thread\n");
    println!(
        "{:<22}  {:>8}  {:>7}  {:>7}  {:>7}  {:>8}  {:>11}  {:>9}  {:>10}",
        "who looks", "n", "p50", "p99", "p99.9", "max", "page faults", "preempted", "p99.9 is x"
    );
    for case in cases {
        println!(
            "{:<22}  {:>8}  {:7.2}  {:7.2}  {:7.2}  {:8.2}  {:>11}  {:>9}  {:>10.2}",
            case.name,
            case.messages,
            case.p50_us,
            case.p99_us,
            case.p999_us,
            case.max_us,
            case.page_faults,
            case.preempted,
            case.p999_us / cases[0].p999_us
        );
    }
}
