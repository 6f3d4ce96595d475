// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report as one page that needs nothing else.

use std::fmt::{self, Write};

use tautline_harness::claims::Verdict;
use tautline_harness::page::{self, END, begin, escape, list, verdicts};
use tautline_harness::rows::Row;
use tautline_harness::table::Column::{Text, Words};
use tautline_harness::table::{Table, of_rows, short, size};

use crate::Result;
use crate::figures::{Bar, bars, distributions, fan_out, latency_by_size};
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
    write_latency(&mut out, report)?;
    write_bars(&mut out, report)?;
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

fn write_figure(out: &mut String, svg: Option<String>, caption: &str) -> fmt::Result {
    svg.map_or(Ok(()), |svg| page::figure(out, &svg, &escape(caption)))
}

fn write_latency(out: &mut String, report: &Report) -> Result<()> {
    let rows = &report.rows;
    if !rows.iter().any(|row| ["latency/", "open-loop/"].iter().any(|kind| row.experiment.starts_with(kind)))
    {
        return Ok(());
    }
    out.push_str("<h2>Latency by size</h2>\n");
    for (experiment, caption) in [
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
    ] {
        write_figure(out, latency_by_size(rows, experiment)?, caption)?;
    }
    out.push_str("<h2>Distributions</h2>\n");
    for bytes in [64, 1 << 20] {
        let caption =
            format!("Half round trips of {}, written and read whole, idle states held off.", size(bytes));
        let axis = "half a round trip";
        write_figure(out, distributions(rows, "latency/whole/held-off", bytes, axis)?, &caption)?;
    }
    for (load, how) in [("quiet", "with a quiet machine"), ("load", "under load")] {
        let experiment = format!("open-loop/{load}/held-off");
        let caption = format!("One way of 1 KiB at 1 kHz {how}, idle states held off.");
        write_figure(out, distributions(rows, &experiment, 1 << 10, "one way")?, &caption)?;
    }
    Ok(())
}

fn write_bars(out: &mut String, report: &Report) -> Result<()> {
    type Number = fn(&Row) -> Option<f64>;
    let of = |experiment: &str, bytes: usize, number: Number, spread: fn(&Row) -> Option<(f64, f64)>| {
        let rows =
            report.rows.iter().filter(|row| row.experiment == experiment && row.payload_bytes == bytes);
        rows.filter_map(|row| Some(Bar::new(row, number(row)?, spread(row)))).collect::<Vec<_>>()
    };
    let rounds: fn(&Row) -> Option<(f64, f64)> = |row| row.spread(|round| Some(round.p50_us));
    let to_p99: fn(&Row) -> Option<(f64, f64)> = |row| row.p50_us.zip(row.p99_us);
    let cpu: fn(&Row) -> Option<(f64, f64)> =
        |row| row.spread(|round| Some(round.cpu_us_per_msg? * round.msgs_per_s? / 1e4));
    let p50: Number = |row| row.p50_us;
    let cpu_percent: Number = |row| row.details.as_ref().map(|details| details.cpu_share * 100.0);
    let pictures = [
        (
            "64 B, idle states as shipped: p50 in µs; whiskers to p99",
            of("latency/whole/as-shipped", 64, p50, to_p99),
            None,
        ),
        (
            "1 KiB at 1 kHz, quiet: p50 in µs; whiskers to p99",
            of("open-loop/quiet/held-off", 1024, p50, to_p99),
            Some(500.0),
        ),
        (
            "1 KiB at 1 kHz, under load: p50 in µs; whiskers to p99",
            of("open-loop/load/held-off", 1024, p50, to_p99),
            Some(500.0),
        ),
        (
            "20 topics at 100 Hz, each at its own time: CPU time of all processes in % of a core; whiskers are the rounds",
            of("robot/20x100Hz/as-shipped", 4096, cpu_percent, cpu),
            None,
        ),
        (
            "20 topics at 100 Hz, all at once: CPU time of all processes in % of a core; whiskers are the rounds",
            of("robot/20x100Hz/at-once/as-shipped", 4096, cpu_percent, cpu),
            None,
        ),
        (
            "20 topics at 100 Hz: resident memory of all processes in MiB; whiskers are the rounds",
            of("robot/20x100Hz/as-shipped", 4096, |row| row.rss_mib, |row| row.spread(|round| round.rss_mib)),
            None,
        ),
        (
            "Throughput at 64 B: 1000 messages/s; whiskers are the rounds",
            of(
                "throughput/held-off",
                64,
                |row| row.details.as_ref().map(|details| details.messages_per_s / 1e3),
                |row| row.spread(|round| Some(round.msgs_per_s? / 1e3)),
            ),
            None,
        ),
        (
            "Throughput at 1 MiB: GB/s; whiskers are the rounds",
            of(
                "throughput/held-off",
                1 << 20,
                |row| {
                    row.details
                        .as_ref()
                        .map(|details| details.messages_per_s * row.payload_bytes as f64 / 1e9)
                },
                |row| row.spread(|round| Some(round.msgs_per_s? * row.payload_bytes as f64 / 1e9)),
            ),
            None,
        ),
        (
            "From the start of the sender to its first message: ms; whiskers are the rounds",
            milliseconds(of("start-up/first-message/as-shipped", 64, p50, rounds)),
            None,
        ),
        (
            "From the start of a late receiver to its first message: ms",
            milliseconds(of("start-up/late-joiner/as-shipped", 64, p50, rounds)),
            None,
        ),
        (
            "100 topics, from the start of the sender to a message on each: ms",
            milliseconds(of("start-up/100-topics/as-shipped", 64, p50, rounds)),
            None,
        ),
    ];
    for (title, all, end) in pictures {
        write_figure(out, bars(title, &all, end)?, "")?;
    }
    for (kind, caption) in [
        (
            "fan-out/one-process/held-off",
            "1 MiB to subscriptions of one process: time until the last one has read it.",
        ),
        ("fan-out/processes/held-off", "1 MiB to one subscription in each of several processes."),
    ] {
        write_figure(out, fan_out(&report.rows, kind)?, caption)?;
    }
    Ok(())
}

fn milliseconds(mut bars: Vec<Bar>) -> Vec<Bar> {
    for bar in &mut bars {
        bar.value /= 1e3;
        bar.spread = bar.spread.map(|(least, most)| (least / 1e3, most / 1e3));
        bar.text = short(bar.value);
    }
    bars
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
