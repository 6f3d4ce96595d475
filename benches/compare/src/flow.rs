// SPDX-License-Identifier: MIT OR Apache-2.0
//! Measurements of what goes one way, and of how it begins.

use std::fs;
use std::time::{Duration, Instant};

use tautline_exchange::{Line, Measured, Memory, to_the_last};
use tautline_harness::Process;
use tautline_harness::rows::Wakes;
use tautline_rt::clock::monotonic_ns;

use crate::Result;
use crate::load;
use crate::pair::{Found, PATIENCE, Setup};
use crate::plan::{Case, Task};

impl Setup<'_> {
    /// Measures messages that are sent one way.
    pub fn flow(&self, case: &Case, topic: &str) -> Result<Found> {
        let is_stream = matches!(case.task, Task::Stream { .. });
        let (processes, is_loaded) = match case.task {
            Task::Paced { processes, is_loaded, .. } => (processes, is_loaded),
            _ => (1, false),
        };
        let (mut fars, endpoint) = self.start_fars(case, topic, processes)?;
        let mut near = self.start_near(case, topic, endpoint, &fars.0)?;
        for far in &mut fars.0 {
            connected(far)?;
        }
        let load = if is_loaded { Some(load::start(self.plan.cores)?) } else { None };
        near.tell("go")?;
        let mut before = None;
        if !is_stream {
            let is_warm = |line| matches!(line, Line::Warm).then_some(());
            // Without one nothing arrives, which is said below.
            let warm = fars.0[0].wait_for(case.budget + DRAIN, is_warm)?;
            before = warm.and_then(|()| waits(&fars.0[0]));
        }
        let sent = near.expect(PATIENCE + case.budget * 3, Line::measured)?;
        if !is_stream {
            let since = Instant::now();
            for far in &mut fars.0 {
                let is_last = |line| matches!(line, Line::Complete).then_some(());
                // Whether it has come: what has not is counted as lost.
                let _ = far.wait_for(DRAIN.saturating_sub(since.elapsed()), is_last)?;
            }
        }
        let after = waits(&fars.0[0]);
        let wakes = before.zip(after).map(|(before, after)| {
            // Since the first measured one.
            let messages = sent.messages.saturating_sub(1).max(1) as f64;
            let per_message = |at: usize| after[at].saturating_sub(before[at]) as f64 / messages;
            Wakes { sampler: per_message(0), others: per_message(1) }
        });
        // Of the sender the times are those of sending.
        let mut of = Measured { times_ns: Vec::new(), lost: 0, ..sent };
        let mut arrivals = Vec::new();
        for far in &mut fars.0 {
            let received = received(far)?;
            of.cpu_ns += received.cpu_ns;
            of.lost += received.lost;
            if is_stream {
                (of.messages, of.seconds) = (received.messages, received.seconds);
            }
            if processes > 1 {
                arrivals.extend(received.numbers.into_iter().zip(received.times_ns));
            } else {
                of.times_ns = received.times_ns;
            }
        }
        near.finish()?;
        drop(load);
        if processes > 1 {
            of.times_ns = to_the_last(arrivals, processes).into_iter().map(|(_, time)| time).collect();
        }
        if of.times_ns.is_empty() {
            return Err(format!("no message arrived everywhere; {} were lost", of.lost).into());
        }
        Ok(Found { of, wakes, ..Found::default() })
    }

    /// Measures from the start of a process to its messages.
    pub fn start_up(&self, case: &Case, topic: &str) -> Result<Found> {
        let is_late_joiner = matches!(case.task, Task::Start { is_late_joiner: true, .. });
        let (mut fars, endpoint) = self.start_fars(case, topic, 1)?;
        let mut started_ns = monotonic_ns();
        let mut near = self.start_near(case, topic, endpoint.clone(), &fars.0)?;
        let mut arrived_ns = connected(&mut fars.0[0])?;
        if is_late_joiner {
            started_ns = monotonic_ns();
            // Its first message may come before it says that it is ready.
            let mut late = self.spawn_far(case, topic, endpoint)?;
            arrived_ns = connected(&mut late)?;
            fars.0.push(late);
        }
        near.tell("go")?;
        let sent = near.expect(PATIENCE, Line::measured)?;
        // Its peers' is in the near end's; of one that came late this is most of it.
        let late = fars.0.get(1).map_or(Memory::default(), |late| Memory::of(&late.id().to_string()));
        for far in &mut fars.0 {
            received(far)?;
        }
        near.finish()?;
        let (times_ns, memory) = (vec![arrived_ns.saturating_sub(started_ns)], sent.memory + late);
        Ok(Found {
            of: Measured { times_ns, messages: 1, memory, ..Measured::default() },
            ..Found::default()
        })
    }

    fn start_fars(&self, case: &Case, topic: &str, processes: usize) -> Result<(Fars<'_>, Option<String>)> {
        let mut fars = Fars(Vec::new());
        let mut endpoints: Vec<String> = Vec::new();
        for _ in 0..processes {
            let (far, endpoint) = self.start_far(case, topic)?;
            fars.0.push(far);
            endpoints.extend(endpoint);
        }
        endpoints.dedup();
        Ok((fars, (!endpoints.is_empty()).then(|| endpoints.join(","))))
    }
}

/// The receiving processes. On a core where one of them never sleeps, none of the others ends before that one is killed.
struct Fars<'a>(Vec<Process<'a, Line>>);

impl Drop for Fars<'_> {
    fn drop(&mut self) {
        self.0.iter_mut().for_each(Process::kill);
    }
}

/// How long what is under way may take to arrive.
const DRAIN: Duration = Duration::from_millis(500);

/// When a receiver had messages on all its subscriptions.
fn connected(far: &mut Process<'_, Line>) -> Result<u64> {
    far.expect(PATIENCE, |line| match line {
        Line::Connected { all_ns } => Some(all_ns),
        _ => None,
    })
}

/// Ends a receiver.
fn received(far: &mut Process<'_, Line>) -> Result<Measured> {
    far.tell("stop")?;
    let received = far.expect(Duration::from_secs(20), Line::measured)?;
    far.finish()?;
    Ok(received)
}

/// How often the main thread of a process has waited, and how often all others.
fn waits(process: &Process<'_, Line>) -> Option<[u64; 2]> {
    let id = process.id();
    let mut waits = [0; 2];
    for task in fs::read_dir(format!("/proc/{id}/task")).ok()?.flatten() {
        let status = fs::read_to_string(task.path().join("status")).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"));
        let is_main = task.file_name().to_str() == Some(&id.to_string());
        waits[usize::from(!is_main)] += line.and_then(|line| line.trim().parse::<u64>().ok()).unwrap_or(0);
    }
    Some(waits)
}
