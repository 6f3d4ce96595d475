// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report as one page that needs nothing else.

use std::fmt::Write;

use tautline_harness::bars::{Bar, bars};
use tautline_harness::page::{self, END, begin, escape, list, verdicts};
use tautline_harness::rows::{Round, Row};
use tautline_harness::table::Column::{Text, Words};
use tautline_harness::table::{Table, of_rows, short};

use crate::Result;
use crate::figures::{distributions, fan_out, latency_by_size};
use crate::load::LOAD;
use crate::modes::{MODES, STRENGTHS};
use crate::plan::Plan;
use crate::report::{AHEAD, Report};
use crate::settings::Extent;

/// The page.
pub fn page(plan: &Plan, report: &Report) -> Result<String> {
    let mut out = String::new();
    begin(
        &mut out,
        "Tautline beside other middleware",
        "Tautline beside other middleware",
        "One run of all systems on one machine: absolute times belong to it, ratios within the run are what is compared.",
    )?;
    if !report.is_realtime {
        out.push_str("<p class=\"late\">Measured without real-time priorities: these are not the numbers to compare.</p>\n");
    }
    verdicts(&mut out, "What must hold", &report.verdicts)?;
    write_ahead(&mut out, report)?;
    write_pictures(&mut out, &report.rows)?;
    write_tables(&mut out, report)?;
    write_settings(&mut out)?;
    list(&mut out, "Method", &method())?;
    list(&mut out, "Machine, versions, conditions", &report.machine)?;
    if plan.extent != Extent::Full {
        out.push_str("<p>A quick run: fewer payloads, rounds and messages than a full one.</p>\n");
    }
    out.push_str(END);
    Ok(out)
}

fn write_ahead(out: &mut String, report: &Report) -> Result<()> {
    if !report.ahead.is_empty() {
        verdicts(out, AHEAD, &report.ahead)?;
    }
    Ok(())
}

/// Medians by size: experiments and captions.
const BY_SIZE: [(&str, &str); 3] = [
    (
        "latency/whole/held-off",
        "Payload written and read whole, idle states held off for all. What a system adds to the floor is its own.",
    ),
    (
        "latency/untouched/held-off",
        "Only 16 bytes of the payload are written and read, idle states held off: who copies, and who does not.",
    ),
    (
        "latency/whole/as-shipped",
        "Payload written and read whole, idle states as the machine has them, but for Tautline's own-default, which holds them off by itself.",
    ),
];

/// Experiment, payload, caption.
const DISTRIBUTIONS: [(&str, usize, &str); 4] = [
    ("latency/whole/held-off", 64, "Half round trips of 64 B, written and read whole, idle states held off."),
    (
        "latency/whole/held-off",
        1 << 20,
        "Half round trips of 1 MiB, written and read whole, idle states held off.",
    ),
    (
        "open-loop/quiet/held-off",
        1 << 10,
        "One way of 1 KiB at 1 kHz with a quiet machine, idle states held off.",
    ),
    ("open-loop/load/held-off", 1 << 10, "One way of 1 KiB at 1 kHz under load, idle states held off."),
];

/// Experiment, payload, what is shown, what was done.
const BARS: [(&str, usize, Value, &str); 11] = [
    ("latency/whole/as-shipped", 64, P50, "64 B, idle states as shipped"),
    ("open-loop/quiet/held-off", 1 << 10, P50, "1 KiB at 1 kHz, quiet"),
    ("open-loop/load/held-off", 1 << 10, P50, "1 KiB at 1 kHz, under load"),
    ("robot/20x100Hz/as-shipped", 4 << 10, CpuShare, "20 topics at 100 Hz, each at its own time"),
    ("robot/20x100Hz/at-once/as-shipped", 4 << 10, CpuShare, "20 topics at 100 Hz, all at once"),
    ("robot/20x100Hz/as-shipped", 4 << 10, Memory, "20 topics at 100 Hz"),
    ("throughput/held-off", 64, Messages, "Throughput at 64 B"),
    ("throughput/held-off", 1 << 20, Bytes, "Throughput at 1 MiB"),
    ("start-up/first-message/as-shipped", 64, Start, "From the start of the sender to its first message"),
    ("start-up/late-joiner/as-shipped", 64, Start, "From the start of a late receiver to its first message"),
    (
        "start-up/100-topics/as-shipped",
        64,
        Start,
        "100 topics, from the start of the sender to a message on each",
    ),
];

/// Times to the last subscription by their number: experiments and captions.
const FAN_OUT: [(&str, &str); 2] = [
    (
        "fan-out/one-process/held-off",
        "1 MiB to subscriptions of one process: time until the last one has read it.",
    ),
    ("fan-out/processes/held-off", "1 MiB to one subscription in each of several processes."),
];

/// What bars show.
#[derive(Clone, Copy)]
enum Value {
    P50,
    Start,
    CpuShare,
    Memory,
    Messages,
    Bytes,
}
use Value::*;

impl Value {
    /// With its unit and what the whiskers are.
    fn title(self) -> &'static str {
        match self {
            P50 => "p50 in µs; whiskers to p99",
            Start => "ms; whiskers are the rounds",
            CpuShare => "CPU time of all processes in % of a core; whiskers are the rounds",
            Memory => "resident memory of all processes in MiB; whiskers are the rounds",
            Messages => "1000 messages/s; whiskers are the rounds",
            Bytes => "GB/s; whiskers are the rounds",
        }
    }

    fn of(self, row: &Row) -> Option<(f64, Option<(f64, f64)>)> {
        let details = row.details.as_ref();
        let (rate, gigabytes) = (details.map(|of| of.messages_per_s), row.payload_bytes as f64 / 1e9);
        Some(match self {
            P50 => (row.p50_us?, row.p50_us.zip(row.p99_us)),
            Start => (row.p50_us? / 1e3, row.spread(|round| Some(round.p50_us / 1e3))),
            CpuShare => {
                let percent = |round: &Round| Some(round.cpu_us_per_msg? * round.msgs_per_s? / 1e4);
                (details?.cpu_share * 100.0, row.spread(percent))
            }
            Memory => (row.rss_mib?, row.spread(|round| round.rss_mib)),
            Messages => (rate? / 1e3, row.spread(|round| Some(round.msgs_per_s? / 1e3))),
            Bytes => (rate? * gigabytes, row.spread(|round| Some(round.msgs_per_s? * gigabytes))),
        })
    }

    fn bar(self, row: &Row) -> Option<Bar> {
        let (value, spread) = self.of(row)?;
        let (label, system) = (row.name(), row.system.clone());
        Some(Bar { label, system, value: Some(value), spread, text: short(value) })
    }
}

fn write_pictures(out: &mut String, rows: &[Row]) -> Result<()> {
    let write = |out: &mut String, svg: Option<String>, caption: &str| {
        svg.map_or(Ok(()), |svg| page::figure(out, &svg, &escape(caption)))
    };
    let is_latency =
        |row: &Row| ["latency/", "open-loop/"].iter().any(|kind| row.experiment.starts_with(kind));
    if rows.iter().any(is_latency) {
        out.push_str("<h2>Latency by size</h2>\n");
        for (experiment, caption) in BY_SIZE {
            write(out, latency_by_size(rows, experiment)?, caption)?;
        }
        out.push_str("<h2>Distributions</h2>\n");
        for (experiment, bytes, caption) in DISTRIBUTIONS {
            let axis = if experiment.starts_with("latency/") { "half a round trip" } else { "one way" };
            write(out, distributions(rows, experiment, bytes, axis)?, caption)?;
        }
    }
    for (experiment, bytes, value, what) in BARS {
        let is_shown = |row: &&Row| (&*row.experiment, row.payload_bytes) == (experiment, bytes);
        let all: Vec<Bar> = rows.iter().filter(is_shown).filter_map(|row| value.bar(row)).collect();
        // One that is late by far would make all others short.
        let end = experiment.starts_with("open-loop/").then_some(500.0);
        write(out, bars(&format!("{what}: {}", value.title()), &all, end, &[])?, "")?;
    }
    for (kind, caption) in FAN_OUT {
        write(out, fan_out(rows, kind)?, caption)?;
    }
    Ok(())
}

fn write_tables(out: &mut String, report: &Report) -> Result<()> {
    out.push_str(
        "<h2>All numbers</h2>\n<p>Times in µs; CPU: of sending and receiving one message together, of fan-out to all \
         subscriptions, in µs; memory: resident, of all processes, what they share counts once.</p>\n",
    );
    for (title, rows) in report.tables() {
        writeln!(out, "<h3>{title}</h3>")?;
        of_rows(rows).html(out)?;
    }
    Ok(())
}

fn write_settings(out: &mut String) -> Result<()> {
    out.push_str("<h2>Settings of each system</h2>\n");
    let mut table = Table::new(1, [Words("system"), Words("mode"), Text("settings")]);
    for mode in MODES {
        table.add([mode.system.into(), mode.mode.into(), mode.settings.into()]);
    }
    table.html(out)?;
    out.push_str("<h2>What others do better</h2>\n<ul>\n");
    for (system, strength) in STRENGTHS {
        writeln!(out, "<li><b>{system}</b>: {}</li>", escape(strength))?;
    }
    out.push_str("</ul>\n");
    Ok(())
}

fn method() -> Vec<String> {
    [
        "Two processes (or more, of fan-out), pinned: the sender to one core, the receivers to the other. The threads that send or are called back have SCHED_FIFO 50, and so have those that a system starts by itself, but for Tautline's samplers (60), which wake its callback threads, and for the network threads of its gateways and of hiroz (80), which must not wait for callbacks; a mode called ordinary has none of it. Every process locks its memory (mlockall, on fault), and malloc keeps what is freed, as Tautline's context does by itself.",
        "Queues: 10 messages in every system, for throughput at 64 B 100.",
        "No setting comes from the environment or from files of the user: variables such as FASTRTPS_DEFAULT_PROFILES_FILE, CYCLONEDDS_URI and RMW_IMPLEMENTATION are removed.",
        "Each experiment has its own number of rounds; in each of them every system runs directly after its rivals, in the order of the round before reversed. What must hold is judged by the median of the ratios of the rounds, for a machine has slow and fast phases; a rival's best configuration is the one whose rounds have the least median. Not judged: what failed in a round, lost messages, ran without real-time priorities or with idle states that should have been held off, or has fewer than ten times above the quantile; quantiles of so few are left out, and where only all rounds together have enough, they are judged together.",
        "Latency: a message to and fro, half of it. Written and read whole: the sender writes every byte in the place that its system gives it, the receiver looks at every byte; untouched: the first 16 bytes.",
        "Idle states: as shipped, or held off for all by /dev/cpu_dma_latency, taken and released for each measurement. On a virtual machine leaving an idle state costs far more than any middleware.",
        "One way: the sender stamps the message with CLOCK_MONOTONIC before it asks for memory; the receiver reads the clock when it has read it and given its memory back. The sender keeps its rate whatever becomes of the messages; a message that was due while the one before was still being sent is stamped with the time at which it was due. What is under way at the end has 500 ms to arrive.",
        "CPU time: of latency that of one end, which sends and receives one message per round trip; else that of all processes, by their own clocks, from the end of the warm-up to the last message, per message that was sent; of throughput, per message that was received.",
        "Throughput: as fast as the receiver lets the sender: keep all and reliable, or what a system has of it; times are those between arrivals, means of 16.",
        "Requests: whole round trips, both ends blocking; the response has 64 bytes.",
        "A window: the sender goes on while 4 MiB are not confirmed by the receiver, which confirms each quarter of it.",
        "Start-up: from before the process is started to its message in the receiver; includes loading the program. The sender tries every millisecond, with 100 topics a round of them every 10 ms.",
        "A message is lost if its number never arrives at a subscription, counted after the warm-up; of throughput, if a later one arrives: what is still queued when the measurement ends counts as neither received nor lost.",
    ]
    .map(str::to_owned)
    .into_iter()
    .chain([format!("Load: {LOAD}.")])
    .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::measurable;

    #[test]
    fn every_picture_is_of_what_is_measured() {
        let all = measurable();
        let is_there = |experiment: &str, bytes: Option<usize>| {
            all.iter()
                .any(|(name, of)| name.starts_with(experiment) && bytes.is_none_or(|bytes| bytes == *of))
        };
        let of_any_size = BY_SIZE.into_iter().chain(FAN_OUT).map(|(experiment, _)| (experiment, None));
        let distributions = DISTRIBUTIONS.map(|(experiment, bytes, ..)| (experiment, Some(bytes)));
        let bars = BARS.map(|(experiment, bytes, ..)| (experiment, Some(bytes)));
        for (experiment, bytes) in of_any_size.chain(distributions).chain(bars) {
            assert!(is_there(experiment, bytes), "{experiment} {bytes:?}");
        }
    }
}
