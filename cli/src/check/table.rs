// SPDX-License-Identifier: MIT OR Apache-2.0
//! The verdict as a table for people: callbacks, chains, cores, warnings.
use std::collections::BTreeMap;
use std::io::{self, Write};

use tautline_analysis::file::{CheckedCallback, CheckedSystem, JoinPolicy, WakeUp};

use crate::table::{BAD, GOOD, WARNING, count, ms, priority, write_table};

/// Writes for each join how many messages it queues, and how long a message waits for the others.
fn write_joins(checked: &CheckedSystem, out: &mut impl Write) -> io::Result<()> {
    let mut rows = Vec::new();
    for callback in &checked.callbacks {
        let Some(join) = &callback.join else { continue };
        let stamps = match join.window_ns {
            None if callback.entry.policy == JoinPolicy::LatestTime => {
                "newest, at the fastest's rate".to_owned()
            }
            None => "newest of each".to_owned(),
            Some(0) => "equal".to_owned(),
            Some(_) => format!("within {} ms", ms(join.window_ns)),
        };
        for (i, (topic, wait_ns)) in join.inputs.iter().enumerate() {
            let of_all = |text: String| if i == 0 { text } else { String::new() };
            let queue = join.window_ns.map_or("-".into(), |_| join.queue_size.to_string());
            let (name, stamps) = (of_all(callback.entry.name.clone()), of_all(stamps.clone()));
            rows.push((true, vec![name, stamps, topic.clone(), of_all(queue), ms(*wait_ns)]));
        }
    }
    if rows.is_empty() {
        return Ok(());
    }
    writeln!(out)?;
    write_table(&["waits", "for stamps", "of topic", "queue\nsize", "wait\nms"], 3, rows, out)
}

/// Writes which stalls make queues deeper than the bounds alone would.
fn write_stalls(checked: &CheckedSystem, out: &mut impl Write) -> io::Result<()> {
    let stall = |(host, ns): (&str, u64)| {
        let host = if host.is_empty() { "this host".to_owned() } else { format!("host {host}") };
        format!("a stall of {} ms of {host}", ns as f64 / 1e6)
    };
    let stalls: Vec<_> = checked.stalls().into_iter().map(stall).collect();
    if stalls.is_empty() {
        return Ok(());
    }
    let is_deeper = |callback: &&CheckedCallback| callback.capacity != callback.capacity_without_stall;
    let deeper = checked.callbacks.iter().filter(is_deeper).count();
    let (stalls, all) = (stalls.join(" and "), checked.callbacks.len());
    writeln!(out, "Queues outlast {stalls}: {deeper} of {all} capacities are larger for it.")
}

/// Writes which execution times hold only up to an input size.
fn write_inputs(checked: &CheckedSystem, out: &mut impl Write) -> io::Result<()> {
    let of_one = |callback: &CheckedCallback| {
        Some(format!("{} for inputs up to {}", callback.entry.name, callback.entry.input_max?))
    };
    let stated: Vec<_> = checked.callbacks.iter().filter_map(of_one).collect();
    if stated.is_empty() {
        return Ok(());
    }
    writeln!(out, "wcet holds of {}.", stated.join(", "))
}

/// Writes which threads publishers wake, and why the sampler wakes the others, which are grouped by reason.
fn write_wake_ups(checked: &CheckedSystem, out: &mut impl Write) -> io::Result<()> {
    let mut groups: Vec<(WakeUp, Vec<&str>)> = Vec::new();
    for CheckedCallback { entry, .. } in &checked.callbacks {
        match groups.iter_mut().find(|(wake_up, _)| *wake_up == entry.wake_up) {
            Some((_, threads)) if threads.contains(&entry.thread.as_str()) => {}
            Some((_, threads)) => threads.push(&entry.thread),
            None => groups.push((entry.wake_up, vec![entry.thread.as_str()])),
        }
    }
    if groups.iter().all(|(wake_up, _)| *wake_up != WakeUp::Publisher) {
        return Ok(());
    }
    let group = |(wake_up, threads): (WakeUp, Vec<&str>)| match wake_up {
        WakeUp::Publisher => format!("publishers wake {}", threads.join(", ")),
        WakeUp::Sampler(because) => format!("the sampler wakes {} ({because})", threads.join(", ")),
    };
    groups.sort_by_key(|(wake_up, _)| *wake_up != WakeUp::Publisher);
    let groups: Vec<_> = groups.into_iter().map(group).collect();
    writeln!(out, "Wake-ups: {}.", groups.join("; "))
}

/// Writes the priorities of threads that run callbacks at other ones.
fn write_ceilings(checked: &CheckedSystem, out: &mut impl Write) -> io::Result<()> {
    let entries = checked.callbacks.iter().map(|callback| &callback.entry);
    let lowered = entries.filter(|entry| entry.lowest_priority < entry.priority);
    let ceilings: BTreeMap<_, _> =
        lowered.map(|entry| ((entry.core, entry.thread.as_str()), entry.priority)).collect();
    if ceilings.is_empty() {
        return Ok(());
    }
    let ceilings: Vec<_> =
        ceilings.into_iter().map(|((_, thread), priority)| format!("{thread} at {priority}")).collect();
    writeln!(
        out,
        "Threads with the priority of the callback that they run wait at the highest: {}.",
        ceilings.join(", ")
    )
}

/// Writes the whole verdict; failed lines are red.
pub fn write(checked: &CheckedSystem, out: &mut impl Write) -> io::Result<()> {
    let several = checked.cores.iter().any(|core| core.host != checked.cores[0].host);
    let core = |callback: &CheckedCallback| {
        let number = if callback.entry.floats { "any".into() } else { callback.core.to_string() };
        if several { format!("{}:{number}", callback.host) } else { number }
    };
    let row = |callback: &CheckedCallback| {
        vec![
            callback.entry.name.clone(),
            callback.entry.thread.clone(),
            core(callback),
            priority(callback.entry.running_priority()),
            ms(Some(callback.period_ns)),
            ms(Some(callback.wcet_ns)),
            ms(callback.response_ns),
            ms(callback.response_overhead_ns),
            ms(Some(callback.entry.deadline_ns)),
            slack(callback.response_overhead_ns, callback.entry.deadline_ns),
            callback.capacity.map_or("-".into(), |capacity| capacity.to_string()),
        ]
    };
    let head = [
        "callback",
        "thread",
        "core",
        "prio",
        "period\nms",
        "wcet\nms",
        "R\nms",
        "R+\noverhead",
        "deadline\nms",
        "slack\nms",
        "capacity",
    ];
    let rows = checked.callbacks.iter().map(|callback| (callback.met, row(callback)));
    write_table(&head, 3, rows.collect(), out)?;
    write_stalls(checked, out)?;
    write_inputs(checked, out)?;
    write_wake_ups(checked, out)?;
    write_ceilings(checked, out)?;
    if !checked.chains.is_empty() {
        writeln!(out)?;
        let rows = checked.chains.iter().map(|chain| {
            let times = [chain.latency_ns, Some(chain.deadline_ns)].map(ms);
            let more = [slack(chain.latency_ns, chain.deadline_ns), ms(chain.reaction_ns), ms(chain.age_ns)];
            (chain.met, [vec![chain.name.clone()], times.to_vec(), more.to_vec()].concat())
        });
        let head = ["chain", "latency\nms", "deadline\nms", "slack\nms", "reaction\nms", "data age\nms"];
        write_table(&head, 1, rows.collect(), out)?;
    }
    write_joins(checked, out)?;
    writeln!(out)?;
    let cores = checked.cores.iter().map(|core| {
        let host = if several { format!("{}:", core.host) } else { String::new() };
        format!("core {host}{} {:.1} %", core.number, core.utilisation * 100.0)
    });
    writeln!(out, "Utilisation with overheads: {}.", cores.collect::<Vec<_>>().join(", "))?;
    for warning in &checked.warnings {
        writeln!(out, "{WARNING}warning:{WARNING:#} {warning}")?;
    }
    verdict(checked, out)
}

fn verdict(checked: &CheckedSystem, out: &mut impl Write) -> io::Result<()> {
    if checked.schedulable {
        let (callbacks, chains) = (checked.callbacks.len(), checked.chains.len());
        let counts = format!("{}, {}", count(callbacks, "callback"), count(chains, "chain"));
        return writeln!(out, "{GOOD}Schedulable: every deadline is met ({counts}).{GOOD:#}");
    }
    let callbacks = checked.callbacks.iter().filter(|c| !c.met).map(|c| format!("callback {}", c.entry.name));
    let chains = checked.chains.iter().filter(|c| !c.met).map(|c| format!("chain {}", c.name));
    let late: Vec<_> = callbacks.chain(chains).collect();
    if late.is_empty() {
        return writeln!(
            out,
            "{BAD}Not schedulable: the bounds do not hold as the file is, see the warnings.{BAD:#}"
        );
    }
    writeln!(out, "{BAD}Not schedulable: {} may miss the deadline.{BAD:#}", late.join(", "))
}

/// The time between response and deadline, rounded down.
fn slack(response: Option<u64>, deadline: u64) -> String {
    let us = |response: u64| (i128::from(deadline) - i128::from(response)).div_euclid(1_000);
    response.map_or("-".into(), |response| format!("{:.3}", us(response) as f64 / 1e3))
}
