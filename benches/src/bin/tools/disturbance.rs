// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does a publisher notice that somebody looks?
//!
//! A thread publishes at 1 kHz, with a real-time priority if it may have one, and times each publication, while nobody looks and
//! while `taut` does, in alternating rounds. What the kernel counts for the thread says more than times do: page faults, and how
//! often it lost its core. What a recorder adds to p99.9 is judged in `recording`, where there are enough publications for that:
//! here two equal cases differ by more. That an observer costs no system call is a test (`transport/tests/syscalls.rs`).

use crate::{DOMAIN, Looking, Result, Taut, as_robot};
use std::time::Duration;
use tautline::geometry_msgs::msg::Point;
use tautline_harness::Distribution;
use tautline_harness::readings::Reading;
use tautline_harness::rows::{Tally, median};
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

/// What was measured of a case.
#[derive(Clone, Default)]
struct Case {
    tally: Tally,
    /// Of the publishing thread, in all rounds.
    page_faults: u64,
    /// How often it lost its core.
    preempted: u64,
    /// Rounds in which there were page faults.
    faulted_rounds: u32,
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

pub fn measure(taut: &Taut, quick: bool) -> Result<Vec<Reading>> {
    let (rounds, messages) = if quick { (2_u32, 500) } else { (10, 3000) };
    let taut = taut.clone();
    let participant = Participant::new(DOMAIN)?;
    let publisher = participant.create_publisher::<Point>("/looked_at", Qos::default(), Limits::default())?;
    let subscription =
        participant.create_subscription::<Point>("/looked_at", Qos::default(), Limits::default())?;
    subscription.set_quiet(true);
    let cores: Vec<_> = CoreSet::allowed()?.iter().map(|core| core.to_string()).collect();
    // On a machine of one core they are on it.
    let others = cores[..cores.len().saturating_sub(1).max(1)].join(",");
    let mut all = vec![Case::default(); CASES.len()];
    // As in processes with real-time threads.
    if let Err(error) = lock_memory(MemoryLock::OnFault) {
        println!("memory is not locked: {error}");
    }
    let worker = std::thread::spawn(move || -> Result<_> {
        as_robot(80)?;
        // Pages and caches are there.
        round(&publisher, &subscription, 200, &mut Distribution::new());
        for number in 1..=rounds {
            for ((_, arguments, _), case) in CASES.iter().zip(&mut all) {
                let argument =
                    |argument: &&'static str| if *argument == OTHERS { others.as_str() } else { *argument };
                let arguments: Vec<&str> = arguments.iter().map(argument).collect();
                let is_looked_at = !arguments.is_empty();
                let looking = is_looked_at.then(|| Looking::start(&taut, &arguments)).transpose()?;
                // It has begun to look, and who is taken from has been set up for it.
                std::thread::sleep(Duration::from_millis(400));
                round(&publisher, &subscription, 100, &mut Distribution::new());
                // Its memory may be new, and then costs page faults.
                let mut times = Distribution::new();
                let [faults_before, preempted_before] = counted()?;
                round(&publisher, &subscription, messages, &mut times);
                let [faults, preempted] = counted()?;
                case.tally.add(number, &times);
                case.page_faults += faults - faults_before;
                case.preempted += preempted - preempted_before;
                case.faulted_rounds += u32::from(faults > faults_before);
                drop(looking);
            }
        }
        Ok(all)
    });
    let cases = worker.join().map_err(|_| "the publishing thread panicked")??;
    let (mut readings, mut nobodys_us) = (Vec::new(), None);
    for (case, (name, _, is_free)) in cases.iter().zip(CASES) {
        let Case { tally, page_faults, preempted, faulted_rounds } = case;
        // Of a round, the median of all: one stall of the host is in the maximum only.
        let p999_us = median(tally.rounds.iter().map(|round| round.p999_us).collect()).unwrap_or(f64::NAN);
        let ratio = p999_us / *nobodys_us.get_or_insert(p999_us);
        let note = format!("preempted {preempted} times, p99.9 {ratio:.2} x nobody's");
        let one = Reading::of("publishing", 0, name, "µs").times(&tally.times).note(note);
        readings.push(Reading { p999: Some(p999_us), ..one });
        let experiment = if is_free { "page faults" } else { "page faults, with a subscription" };
        let share = f64::from(*faulted_rounds) / f64::from(rounds);
        // What looking costs comes in each round; what the kernel moves about does not.
        let one = Reading::of(experiment, 0, name, "of the rounds").value(share);
        let one = one.at_most(is_free.then_some(0.99)).must();
        readings.push(one.note(format!("{page_faults} page faults of the publisher")));
    }
    Ok(readings)
}
