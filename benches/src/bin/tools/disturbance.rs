// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does a publisher notice that somebody looks?
//!
//! A thread publishes at 1 kHz, with a real-time priority if it may have one, and times each publication, while nobody looks and
//! while `taut` does, in alternating rounds. What the kernel counts for the thread says more than times do: page faults, and how
//! often it lost its core. What a recorder adds to p99.9 is judged in `recording`, where there are enough publications for that:
//! here two equal cases differ by more. That an observer costs no system call is a test (`transport/tests/syscalls.rs`).

use crate::{DOMAIN, Looking, Result, Taut, as_robot};
use serde::Serialize;
use std::time::Duration;
use tautline::geometry_msgs::msg::Point;
use tautline_benches::table::Column::{Number, Words};
use tautline_benches::table::Table;
use tautline_benches::{Distribution, cells, rows};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_rt::{CoreSet, MemoryLock, lock_memory};
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

/// What was measured of a case in its rounds so far.
#[derive(Clone, Default)]
struct Tally {
    times: Distribution,
    p999_us: Vec<f64>,
    page_faults: u64,
    preempted: u64,
    faulted_rounds: u64,
}

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
    times: &mut Distribution,
) {
    let start_ns = monotonic_ns();
    for n in 0..messages {
        sleep_until_monotonic(start_ns + n * PERIOD_NS);
        let before_ns = monotonic_ns();
        if let Ok(mut loan) = publisher.loan() {
            loan.x = n as f64;
            let _ = loan.publish();
        }
        times.record(monotonic_ns() - before_ns);
        while let Ok(Some(_)) = subscription.try_take() {}
    }
}

/// Prints the cases, and adds what does not hold to `broken`.
pub fn measure(taut: &Taut, quick: bool, broken: &mut Vec<String>) -> Result<Vec<Case>> {
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
    let mut all = vec![Tally::default(); CASES.len()];
    // As in processes with real-time threads.
    if let Err(error) = lock_memory(MemoryLock::OnFault) {
        println!("memory is not locked: {error}");
    }
    let worker = std::thread::spawn(move || -> Result<_> {
        as_robot(80)?;
        // Pages and caches are there.
        round(&publisher, &subscription, 200, &mut Distribution::new());
        for _ in 0..rounds {
            for ((_, arguments, _), tally) in CASES.iter().zip(&mut all) {
                let argument =
                    |argument: &&'static str| if *argument == OTHERS { others.as_str() } else { *argument };
                let arguments: Vec<&str> = arguments.iter().map(argument).collect();
                let is_looked_at = !arguments.is_empty();
                let looking = is_looked_at.then(|| Looking::start(&taut, &arguments)).transpose()?;
                // It has begun to look, and who is taken from has been set up for it.
                std::thread::sleep(Duration::from_millis(400));
                round(&publisher, &subscription, 100, &mut Distribution::new());
                let [faults_before, preempted_before] = counted()?;
                let mut times = Distribution::new();
                round(&publisher, &subscription, messages, &mut times);
                let [faults, preempted] = counted()?;
                tally.times.add(&times.counts());
                tally.p999_us.push(times.quantile_us(0.999));
                tally.page_faults += faults - faults_before;
                tally.preempted += preempted - preempted_before;
                tally.faulted_rounds += u64::from(faults > faults_before);
                drop(looking);
            }
        }
        Ok(all)
    });
    let all = worker.join().map_err(|_| "the publishing thread panicked")??;
    let case = |((name, ..), tally): (&(&'static str, _, _), Tally)| Case {
        name,
        messages: tally.times.len(),
        p50_us: tally.times.quantile_us(0.5),
        p99_us: tally.times.quantile_us(0.99),
        p999_us: rows::median(tally.p999_us).unwrap_or(0.0),
        max_us: tally.times.max_us(),
        page_faults: tally.page_faults,
        preempted: tally.preempted,
        faulted_rounds: tally.faulted_rounds,
    };
    let cases: Vec<Case> = CASES.iter().zip(all).map(case).collect();
    print(&cases);
    for (Case { name, page_faults, faulted_rounds, .. }, (.., is_free)) in cases.iter().zip(CASES) {
        if is_free && *faulted_rounds == rounds {
            broken.push(format!("{name}: {page_faults} page faults of the publisher, some in every round"));
        }
    }
    Ok(cases)
}

fn print(cases: &[Case]) {
    println!("a publication at 1 kHz, in us, and what the kernel counts of its thread\n");
    let numbers = ["n", "p50", "p99", "p99.9", "max", "page faults", "preempted", "p99.9 is x"];
    let columns = [Words("who looks")].into_iter().chain(numbers.map(Number));
    let mut table = Table::new(0, columns.collect::<Vec<_>>());
    for case in cases {
        let times = [case.p50_us, case.p99_us, case.p999_us, case.max_us];
        let [p50, p99, p999, max] = times.map(|us| format!("{us:.2}"));
        let ratio = format!("{:.2}", case.p999_us / cases[0].p999_us);
        let (faults, preempted) = (case.page_faults, case.preempted);
        table.add(cells![case.name, case.messages, p50, p99, p999, max, faults, preempted, ratio]);
    }
    println!("{table}");
}
