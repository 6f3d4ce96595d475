// SPDX-License-Identifier: MIT OR Apache-2.0
//! The verdict for people: callbacks, chains, cores, warnings.
use std::io::{self, Write};

use anstyle::{AnsiColor, Style};
use comfy_table::{CellAlignment, LineStyle, Table, TableStyle};
use tautline_analysis::file::{CheckedCallback, CheckedSystem};

const GOOD: Style = AnsiColor::Green.on_default();
const BAD: Style = AnsiColor::Red.on_default();
const WARNING: Style = AnsiColor::Yellow.on_default();

/// Writes all there is to know; lines that fail are red.
pub fn write(checked: &CheckedSystem, out: &mut impl Write) -> io::Result<()> {
    let several = checked.cores.iter().any(|core| core.host != checked.cores[0].host);
    let core = |callback: &CheckedCallback| match several {
        true => format!("{}:{}", callback.host, callback.core),
        false => callback.core.to_string(),
    };
    let row = |callback: &CheckedCallback| {
        vec![
            callback.entry.name.clone(),
            callback.entry.thread.clone(),
            core(callback),
            callback.entry.priority.to_string(),
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
        let count = |n: usize, what| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
        let (callbacks, chains) = (checked.callbacks.len(), checked.chains.len());
        let counts = format!("{}, {}", count(callbacks, "callback"), count(chains, "chain"));
        return writeln!(out, "{GOOD}Schedulable: every deadline is met ({counts}).{GOOD:#}");
    }
    let callbacks = checked.callbacks.iter().filter(|c| !c.met).map(|c| format!("callback {}", c.entry.name));
    let chains = checked.chains.iter().filter(|c| !c.met).map(|c| format!("chain {}", c.name));
    let late: Vec<_> = callbacks.chain(chains).collect();
    writeln!(out, "{BAD}Not schedulable: {} may miss the deadline.{BAD:#}", late.join(", "))
}

/// A table whose first `left` columns are text and whose failed rows are red.
fn write_table(
    head: &[&str],
    left: usize,
    rows: Vec<(bool, Vec<String>)>,
    out: &mut impl Write,
) -> io::Result<()> {
    let style = TableStyle::new().header_separator(LineStyle::none().fill('─').junction('─'));
    let mut table = Table::new();
    table.load_style(style).set_header(head.iter().copied());
    for (_, row) in &rows {
        table.add_row(row.clone());
    }
    for (i, column) in table.column_iter_mut().enumerate() {
        column.set_padding((0, 2));
        if i >= left {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    let lines: Vec<_> = table.lines().collect();
    let heading = lines.len() - rows.len();
    for (i, line) in lines.iter().enumerate() {
        let line = line.trim_end();
        let failed = i.checked_sub(heading).is_some_and(|row| !rows[row].0);
        match failed {
            true => writeln!(out, "{BAD}{line}{BAD:#}")?,
            false => writeln!(out, "{line}")?,
        }
    }
    Ok(())
}

/// Rounded up, as a bound must be; "-" without one.
fn ms(ns: Option<u64>) -> String {
    ns.map_or("-".into(), |ns| format!("{:.3}", ns.div_ceil(1_000) as f64 / 1e3))
}

/// Rounded down.
fn slack(response: Option<u64>, deadline: u64) -> String {
    let us = |response: u64| (i128::from(deadline) - i128::from(response)).div_euclid(1_000);
    response.map_or("-".into(), |response| format!("{:.3}", us(response) as f64 / 1e3))
}
