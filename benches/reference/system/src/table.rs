// SPDX-License-Identifier: MIT OR Apache-2.0
//! The indicators as a table: a column for each way to run the nodes.

use comfy_table::{CellAlignment, LineStyle, Table, TableStyle};
use std::io::{self, Write};

use crate::report::Report;

/// Prints one column for each report, and beside it its bounds if it has any.
pub fn print(reports: &[&Report], out: &mut impl Write) -> io::Result<()> {
    let style = TableStyle::new().header_separator(LineStyle::none().fill('─').junction('─'));
    let mut table = Table::new();
    let has_bound =
        |report: &Report| report.hot_path_bound_ms.is_some() || report.planner_jitter_bound_ms.is_some();
    let mut head = vec![String::new()];
    for report in reports {
        head.push(format!("{}\n{}", report.kpis.system, report.kpis.mode));
        if has_bound(report) {
            head.push("bound".to_owned());
        }
    }
    table.load_style(style).set_header(head);
    for row in &ROWS {
        let mut cells = vec![row.name.to_owned()];
        for report in reports {
            cells.push((row.value)(report));
            if has_bound(report) {
                cells.push(bound((row.bound)(report)));
            }
        }
        table.add_row(cells);
    }
    for (index, column) in table.column_iter_mut().enumerate() {
        column.set_padding((0, 2));
        if index > 0 {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table.lines().try_for_each(|line| writeln!(out, "{}", line.trim_end()))
}

/// A bound and whether it was kept.
type Bound = Option<(f64, bool)>;

fn bound(bound: Bound) -> String {
    bound.map_or_else(String::new, |(ms, kept)| format!("{ms:.2} {}", if kept { "kept" } else { "EXCEEDED" }))
}

struct Row {
    name: &'static str,
    value: fn(&Report) -> String,
    bound: fn(&Report) -> Bound,
}

const fn row(name: &'static str, value: fn(&Report) -> String) -> Row {
    Row { name, value, bound: |_| None }
}

static ROWS: [Row; 14] = [
    row("measured, s", |it| format!("{:.0}", it.kpis.seconds)),
    row("CPU, % of a core", |it| format!("{:.1}", it.kpis.cpu_percent)),
    row("memory (RSS), MiB", |it| format!("{:.1}", it.kpis.rss_mib)),
    row("dropped in transforms", |it| it.kpis.dropped_in_transforms.to_string()),
    row("dropped in all nodes", |it| it.kpis.dropped.to_string()),
    row("front-lidar samples without an estimate", |it| {
        format!("{} of {}", it.kpis.front_lidar_without_estimate, it.kpis.front_lidar_samples)
    }),
    row("hot path, average, ms", |it| format!("{:.2}", it.kpis.hot_path_average_ms)),
    row("hot path, p99, ms", |it| format!("{:.2}", it.kpis.hot_path_p99_ms)),
    row("hot path, worst, ms", |it| format!("{:.2}", it.kpis.hot_path_worst_ms)),
    row("from the first lidar, average, ms", |it| format!("{:.2}", it.kpis.both_lidars_average_ms)),
    Row {
        name: "from the first lidar, worst, ms",
        value: |it| format!("{:.2}", it.kpis.both_lidars_worst_ms),
        bound: |it| it.hot_path_bound_ms.zip(it.hot_path_kept),
    },
    row("BehaviorPlanner jitter, average, ms", |it| format!("{:.3}", it.kpis.planner_jitter_average_ms)),
    Row {
        name: "BehaviorPlanner jitter, worst, ms",
        value: |it| format!("{:.3}", it.kpis.planner_jitter_worst_ms),
        bound: |it| it.planner_jitter_bound_ms.zip(it.planner_jitter_kept),
    },
    row("BehaviorPlanner drift, ms", |it| format!("{:.3}", it.kpis.planner_drift_ms)),
];
