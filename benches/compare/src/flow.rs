// SPDX-License-Identifier: MIT OR Apache-2.0
//! Measurements of what goes one way, and of how it begins.

use std::fs;
use std::time::Duration;

use tautline_benches::Process;
use tautline_exchange::{Line, Measured, memory_kib, to_the_last};
use tautline_rt::clock::monotonic_ns;

use crate::Result;
use crate::load::Load;
use crate::pair::{Found, PATIENCE, Setup, measured};
use crate::plan::{Case, Task};

impl Setup<'_> {
    /// Measures messages that are sent one way.
    pub fn flow(&self, case: &Case, topic: &str) -> Result<Found> {
        let (processes, is_loaded) = match case.task {
            Task::Paced { processes, is_loaded, .. } => (processes, is_loaded),
            _ => (1, false),
        };
        let (mut fars, endpoint) = self.start_fars(case, topic, processes)?;
        let mut near = self.start_near(case, topic, endpoint)?;
        for far in &mut fars {
            connected(far)?;
        }
        let load = if is_loaded { Some(Load::start()?) } else { None };
        let before = switches(&fars[0]);
        near.tell("go")?;
        let sent = measured(&mut near, PATIENCE + case.budget * 3)?;
        let switches = before.zip(switches(&fars[0]));
        let mut found = Found {
            cpu_ns: sent.cpu_ns,
            messages: sent.messages,
            seconds: sent.seconds,
            memory_kib: sent.memory_kib,
            // The warm-up is an eighth of what is measured.
            switches: switches.map(|(from, to)| (to - from) as f64 / (sent.messages.max(1) as f64 * 1.125)),
            ..Found::default()
        };
        let memory = fars.iter().map(|far| memory_kib(&far.id().to_string()));
        found.memory_kib += memory.sum::<u64>();
        let mut arrivals = Vec::new();
        for far in &mut fars {
            let received = received(far)?;
            found.cpu_ns += received.cpu_ns;
            found.lost += received.lost;
            if case.task == Task::Stream {
                (found.messages, found.seconds) = (received.messages, received.seconds);
            }
            if processes > 1 {
                arrivals.extend(received.numbers.into_iter().zip(received.times_ns));
            } else {
                found.times_ns = received.times_ns;
            }
        }
        near.finish()?;
        drop(load);
        if processes > 1 {
            found.times_ns = to_the_last(arrivals, processes).into_iter().map(|(_, time)| time).collect();
        }
        if found.times_ns.is_empty() {
            return Err(format!("no message arrived everywhere; {} were lost", found.lost).into());
        }
        Ok(found)
    }

    /// Measures from the start of a process to its messages.
    pub fn start_up(&self, case: &Case, topic: &str) -> Result<Found> {
        let is_late_joiner = matches!(case.task, Task::Start { is_late_joiner: true, .. });
        let (mut fars, endpoint) = self.start_fars(case, topic, 1)?;
        let mut started_ns = monotonic_ns();
        let mut near = self.start_near(case, topic, endpoint.clone())?;
        let mut arrived_ns = connected(&mut fars[0])?;
        if is_late_joiner {
            started_ns = monotonic_ns();
            // Its first message may come before it says that it is ready.
            let mut late = self.spawn_far(case, topic, endpoint)?;
            arrived_ns = connected(&mut late)?;
            fars.push(late);
        }
        near.tell("go")?;
        let sent = measured(&mut near, PATIENCE)?;
        let memory = fars.iter().map(|far| memory_kib(&far.id().to_string())).sum::<u64>() + sent.memory_kib;
        for far in &mut fars {
            received(far)?;
        }
        near.finish()?;
        Ok(Found {
            times_ns: vec![arrived_ns.saturating_sub(started_ns)],
            messages: 1,
            memory_kib: memory,
            ..Found::default()
        })
    }

    fn start_fars(
        &self,
        case: &Case,
        topic: &str,
        processes: usize,
    ) -> Result<(Vec<Process<'_, Line>>, Option<String>)> {
        let mut fars = Vec::new();
        let mut endpoints: Vec<String> = Vec::new();
        for _ in 0..processes {
            let (far, endpoint) = self.start_far(case, topic)?;
            fars.push(far);
            endpoints.extend(endpoint);
        }
        endpoints.dedup();
        Ok((fars, (!endpoints.is_empty()).then(|| endpoints.join(","))))
    }
}

/// When a receiver had messages on all its subscriptions.
fn connected(far: &mut Process<'_, Line>) -> Result<u64> {
    far.expect(PATIENCE, |line| match line {
        Line::Connected { all_ns, .. } => Some(all_ns),
        _ => None,
    })
}

/// Ends a receiver.
fn received(far: &mut Process<'_, Line>) -> Result<Measured> {
    far.tell("stop")?;
    let received = measured(far, Duration::from_secs(20))?;
    far.finish()?;
    Ok(received)
}

/// How often the main thread of a process has waited.
fn switches(process: &Process<'_, Line>) -> Option<u64> {
    let id = process.id();
    let status = fs::read_to_string(format!("/proc/{id}/task/{id}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))?;
    line.trim().parse().ok()
}
