// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report as one page that needs nothing else.

use std::fmt::Write;

use serde::Deserialize;
use tautline_harness::bars::{Bar, bars};
use tautline_harness::claims::Verdict;
use tautline_harness::page::{self, END, begin, escape, list, verdicts};
use tautline_harness::rows::{Round, Row};
use tautline_harness::table::Column::{Text, Words};
use tautline_harness::table::{Table, of_rows, short, size};

use crate::Result;
use crate::figures::{distributions, fan_out, latency_by_size};
use crate::load::LOAD;
use crate::modes::{MODES, SYSTEMS, texts};
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
    if report.ahead.is_empty() {
        return Ok(());
    }
    writeln!(
        out,
        "<h2>{AHEAD}</h2>\n<p>The default mode is blocking, for rivals that never sleep busy-poll; the median of the rounds' \
         ratios, from 1.05 x on.</p>"
    )?;
    let mut table = Table::new(0, [Text("missed"), Text("found"), Text("why it stays")]);
    for Verdict { claim, found, reason, .. } in &report.ahead {
        table.add([claim.into(), found.into(), reason.as_deref().unwrap_or_default().into()]);
    }
    Ok(table.html(out)?)
}

/// The pictures, as `pictures.toml` has them.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Pictures {
    /// Each an experiment and a caption.
    by_size: Vec<[String; 2]>,
    distributions: Vec<Distribution>,
    bars: Vec<Bars>,
    /// The same.
    fan_out: Vec<[String; 2]>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Distribution {
    experiment: String,
    bytes: String,
    axis: String,
    caption: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Bars {
    experiment: String,
    bytes: String,
    value: Value,
    end: Option<f64>,
    title: String,
}

/// What bars show, and their whiskers.
#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Value {
    /// In µs, to p99.
    P50,
    /// In ms. Here and below whiskers are the rounds'.
    Start,
    /// In % of a core.
    CpuShare,
    /// In MiB.
    Memory,
    /// In 1000/s.
    Messages,
    /// In GB/s.
    Bytes,
}

fn pictures() -> Result<Pictures> {
    Ok(toml::from_str(include_str!("../pictures.toml"))?)
}

impl Value {
    fn of(self, row: &Row) -> Option<(f64, Option<(f64, f64)>)> {
        let details = row.details.as_ref();
        let (rate, gigabytes) = (details.map(|of| of.messages_per_s), row.payload_bytes as f64 / 1e9);
        Some(match self {
            Value::P50 => (row.p50_us?, row.p50_us.zip(row.p99_us)),
            Value::Start => (row.p50_us? / 1e3, row.spread(|round| Some(round.p50_us / 1e3))),
            Value::CpuShare => {
                let percent = |round: &Round| Some(round.cpu_us_per_msg? * round.msgs_per_s? / 1e4);
                (details?.cpu_share * 100.0, row.spread(percent))
            }
            Value::Memory => (row.rss_mib?, row.spread(|round| round.rss_mib)),
            Value::Messages => (rate? / 1e3, row.spread(|round| Some(round.msgs_per_s? / 1e3))),
            Value::Bytes => (rate? * gigabytes, row.spread(|round| Some(round.msgs_per_s? * gigabytes))),
        })
    }

    fn bar(self, row: &Row) -> Option<Bar> {
        let (value, spread) = self.of(row)?;
        let (label, system) = (row.name(), row.system.clone());
        Some(Bar { label, system, value: Some(value), spread, text: short(value) })
    }
}

fn write_pictures(out: &mut String, rows: &[Row]) -> Result<()> {
    let pictures = pictures()?;
    let write = |out: &mut String, svg: Option<String>, caption: &str| {
        svg.map_or(Ok(()), |svg| page::figure(out, &svg, &escape(caption)))
    };
    let is_latency =
        |row: &Row| ["latency/", "open-loop/"].iter().any(|kind| row.experiment.starts_with(kind));
    if rows.iter().any(is_latency) {
        out.push_str("<h2>Latency by size</h2>\n");
        for [experiment, caption] in &pictures.by_size {
            write(out, latency_by_size(rows, experiment)?, caption)?;
        }
        out.push_str("<h2>Distributions</h2>\n");
        for Distribution { experiment, bytes, axis, caption } in &pictures.distributions {
            write(out, distributions(rows, experiment, bytes, axis)?, caption)?;
        }
    }
    for Bars { experiment, bytes, value, end, title } in &pictures.bars {
        let is_shown = |row: &&Row| row.experiment == *experiment && size(row.payload_bytes) == *bytes;
        let all: Vec<Bar> = rows.iter().filter(is_shown).filter_map(|row| value.bar(row)).collect();
        write(out, bars(title, &all, *end, &[])?, "")?;
    }
    for [kind, caption] in &pictures.fan_out {
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
    let texts = texts()?;
    for mode in MODES {
        let settings = texts.settings.get(&mode.name()).map_or("", String::as_str);
        table.add([mode.system.into(), mode.mode.into(), settings.into()]);
    }
    table.html(out)?;
    out.push_str("<h2>What others do better</h2>\n<ul>\n");
    for (system, strength) in
        SYSTEMS.iter().filter_map(|system| Some((system, texts.strengths.get(*system)?)))
    {
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
        let payloads = measurable().unwrap().payloads;
        let is_there = |experiment: &str, bytes: &str| {
            payloads
                .iter()
                .any(|(name, of)| name.starts_with(experiment) && ["", &size(*of)].contains(&bytes))
        };
        let Pictures { by_size, distributions, bars, fan_out } = pictures().unwrap();
        let all = by_size.iter().chain(&fan_out).map(|[experiment, _]| (experiment.as_str(), ""));
        let all = all.chain(distributions.iter().map(|of| (of.experiment.as_str(), of.bytes.as_str())));
        for (experiment, bytes) in
            all.chain(bars.iter().map(|of| (of.experiment.as_str(), of.bytes.as_str())))
        {
            assert!(is_there(experiment, bytes), "{experiment} {bytes}");
        }
    }
}
