// SPDX-License-Identifier: MIT OR Apache-2.0
//! The verdict as JSON for scripts. Names, order and units do not change.
use std::io::{self, Write};

use serde::Serialize;
use tautline_analysis::file::{self, CheckedSystem, Executor, JoinPolicy};

use super::admit;
use super::sensitivity::Growth;
use crate::times::ms;

#[derive(Serialize)]
struct Verdict<'a> {
    schedulable: bool,
    callbacks: Vec<Callback<'a>>,
    chains: Vec<Chain<'a>>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    stalls: Vec<Stall<'a>>,
    warnings: &'a [String],
    #[serde(skip_serializing_if = "Option::is_none")]
    sensitivity: Option<&'a Growth>,
    #[serde(skip_serializing_if = "Option::is_none")]
    admission: Option<admit::Verdict<'a>>,
}

/// Times without a bound are null.
#[derive(Serialize)]
struct Callback<'a> {
    name: &'a str,
    host: &'a str,
    core: usize,
    priority: u8,
    /// The priority of its thread while that waits; present if the thread runs callbacks below it.
    #[serde(skip_serializing_if = "Option::is_none")]
    ceiling: Option<u8>,
    wake_up: WakeUp,
    /// Present if it is not a single-threaded one.
    #[serde(skip_serializing_if = "Option::is_none")]
    executor: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reservation: Option<Reservation>,
    period_ms: f64,
    wcet_ms: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    input_max: Option<u64>,
    response_ms: Option<f64>,
    response_overhead_ms: Option<f64>,
    deadline_ms: f64,
    capacity: Option<usize>,
    /// Present if a stall makes the capacity larger.
    #[serde(skip_serializing_if = "Option::is_none")]
    capacity_without_stall: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    join: Option<Join<'a>>,
}

/// What wakes the thread, and the reason if it is the sampler.
#[derive(Serialize)]
struct WakeUp {
    by: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    because: Option<&'static str>,
}

impl WakeUp {
    fn of(wake_up: file::WakeUp) -> Self {
        match wake_up {
            file::WakeUp::Publisher => WakeUp { by: "publisher", because: None },
            file::WakeUp::Sampler(because) => WakeUp { by: "sampler", because: Some(because) },
        }
    }
}

#[derive(Serialize)]
struct Reservation {
    runtime_ms: f64,
    period_ms: f64,
    /// Whether it may run on any core of its host.
    floats: bool,
}

/// A join. Without a window it takes the newest message of each topic. The policy is present if the file names one.
#[derive(Serialize)]
struct Join<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    policy: Option<&'static str>,
    window_ms: Option<f64>,
    queue_size: usize,
    inputs: Vec<Input<'a>>,
}

#[derive(Serialize)]
struct Input<'a> {
    topic: &'a str,
    wait_ms: Option<f64>,
}

#[derive(Serialize)]
struct Chain<'a> {
    name: &'a str,
    latency_ms: Option<f64>,
    deadline_ms: f64,
}

/// A stall that the queues outlast.
#[derive(Serialize)]
struct Stall<'a> {
    host: &'a str,
    stall_ms: f64,
}

/// Writes one JSON object and a newline; it contains `sensitivity` and `admission` only if they were requested.
pub fn write(
    checked: &CheckedSystem,
    growth: Option<&Growth>,
    admission: Option<admit::Verdict<'_>>,
    out: &mut impl Write,
) -> io::Result<()> {
    let callbacks = checked.callbacks.iter().map(|callback| Callback {
        name: &callback.entry.name,
        host: &callback.host,
        core: callback.core,
        priority: callback.entry.running_priority(),
        ceiling: Some(callback.entry.priority).filter(|ceiling| callback.entry.lowest_priority < *ceiling),
        wake_up: WakeUp::of(callback.entry.wake_up),
        executor: Some(callback.entry.executor)
            .filter(|executor| *executor != Executor::SingleThreaded)
            .map(Executor::as_str),
        reservation: callback.entry.reservation.map(|of| Reservation {
            runtime_ms: ms(of.runtime_ns),
            period_ms: ms(of.period_ns),
            floats: callback.entry.floats,
        }),
        period_ms: ms(callback.period_ns),
        wcet_ms: ms(callback.wcet_ns),
        input_max: callback.entry.input_max,
        response_ms: callback.response_ns.map(ms),
        response_overhead_ms: callback.response_overhead_ns.map(ms),
        deadline_ms: ms(callback.entry.deadline_ns),
        capacity: callback.capacity,
        capacity_without_stall: callback
            .capacity_without_stall
            .filter(|_| callback.capacity != callback.capacity_without_stall),
        join: callback.join.as_ref().map(|join| Join {
            policy: Some(callback.entry.policy)
                .filter(|policy| *policy != JoinPolicy::ByWindow)
                .map(JoinPolicy::as_str),
            window_ms: join.window_ns.map(ms),
            queue_size: join.queue_size,
            inputs: join
                .inputs
                .iter()
                .map(|(topic, wait_ns)| Input { topic, wait_ms: wait_ns.map(ms) })
                .collect(),
        }),
    });
    let chains = checked.chains.iter().map(|chain| Chain {
        name: &chain.name,
        latency_ms: chain.latency_ns.map(ms),
        deadline_ms: ms(chain.deadline_ns),
    });
    let verdict = Verdict {
        schedulable: checked.schedulable,
        callbacks: callbacks.collect(),
        chains: chains.collect(),
        stalls: checked.stalls().into_iter().map(|(host, ns)| Stall { host, stall_ms: ms(ns) }).collect(),
        warnings: &checked.warnings,
        sensitivity: growth,
        admission,
    };
    serde_json::to_writer(&mut *out, &verdict)?;
    writeln!(out)
}
