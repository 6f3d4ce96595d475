// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report as one page that needs nothing else.

use tautline_harness::cells;
use tautline_harness::page::{END, begin, figure, list, verdicts};
use tautline_harness::table::Column::{Number, Words};
use tautline_harness::table::{Cell, Table, distinct};
use tautline_paper::Variant;

use crate::Result;
use crate::figures::{ablation_histograms, p99_bars};
use crate::plan::Experiment;
use crate::report::{Report, table, time};
use crate::stats::Row;

pub fn page(report: &Report) -> Result<String> {
    let is_of_ablation = |variant: Variant| variant.is_ablation() || variant == Variant::FUTURES_RT;
    let ablation = variants(&report.rows, is_of_ablation);
    let others = variants(&report.rows, |variant| !variant.is_ablation());
    let mut out = String::new();
    begin(
        &mut out,
        "Tautline: the paper's evaluation",
        "Response times of asynchronous callbacks",
        "The evaluation of <i>A first look at ROS 2 applications written in asynchronous Rust</i> (ECRTS 2025, section 5), \
         run on Tautline and on r2r.",
    )?;
    verdicts(&mut out, "What holds", &report.verdicts)?;
    if !others.is_empty() {
        out.push_str("<h2>Response times of all variants</h2>\n");
        let caption = "99th percentile of the response time, from scheduled release to end of callback, in ms. A bar that ends in \
                       a triangle is longer than the scale; whiskers: the standard deviation of the runs; dashed: the deadline; \
                       line: the response-time analysis.";
        figure(&mut out, &p99_bars(&report.rows, &others)?, caption)?;
    }
    if ablation.len() > 1 {
        out.push_str("<h2>The middleware's priority</h2>\n");
        let caption = "futures-rt with sampler and middleware above the callbacks (21), below them (15), and without a \
                       real-time priority: response times of topic 1, counts on a logarithmic scale.";
        figure(&mut out, &ablation_histograms(&report.rows, &ablation)?, caption)?;
        let caption = "The same: 99th percentiles of all topics, in ms.";
        figure(&mut out, &p99_bars(&report.rows, &ablation)?, caption)?;
    }
    write_capacity(&mut out, report)?;
    out.push_str(
        "<h2>All numbers</h2>\n<p>Times in ms. RTA+ is the prediction with the overhead that was measured.</p>\n",
    );
    table(&report.rows).html(&mut out)?;
    write_disturbed(&mut out, report)?;
    list(&mut out, "Method", &report.notes.method)?;
    list(&mut out, "Machine and versions", &report.notes.machine)?;
    out.push_str(END);
    Ok(out)
}

/// The names of the paper's variants that were measured and are wanted, in the order of the rows.
fn variants(rows: &[Row], is_wanted: impl Fn(Variant) -> bool) -> Vec<String> {
    let is_shown =
        |row: &&Row| matches!(row.cell.experiment, Experiment::Paper(variant) if is_wanted(variant));
    distinct(rows.iter().filter(is_shown).map(|row| row.variant.clone()))
}

fn write_capacity(out: &mut String, report: &Report) -> Result<()> {
    let rows: Vec<_> =
        report.rows.iter().filter(|row| matches!(row.cell.experiment, Experiment::Capacity(_))).collect();
    if rows.is_empty() {
        return Ok(());
    }
    out.push_str(
        "<h2>Queue capacity</h2>\n<p>While <i>goal</i>'s callback computes, <i>scan</i> waits: its queue needs the computed \
         capacity, the larger number here. r2r is asked for as much.</p>\n",
    );
    let words = ["system", "queue", "topic"].map(Words);
    let numbers = ["runs", "published", "handled", "lost", "max ms", "RTA ms"].map(Number);
    let mut table = Table::new(0, [&words[..], &numbers].concat());
    for row in rows {
        let [max, rta] = [row.max_ms, row.rta_ms].map(time);
        let cells = cells![row.system, &row.variant, &row.topic, row.runs, row.published, row.n];
        table.add(cells.into_iter().chain([Cell::bad(row.lost), max.into(), rta.into()]));
    }
    Ok(table.html(out)?)
}

fn write_disturbed(out: &mut String, report: &Report) -> Result<()> {
    out.push_str("<h2>Disturbed runs</h2>\n");
    if report.disturbed.is_empty() {
        out.push_str("<p>The hypervisor took the core from no run.</p>\n");
        return Ok(());
    }
    let numbers = ["run", "steal ticks", "releases missed"].map(Number);
    let words = ["then", "p99 of each topic, ms"].map(Words);
    let mut table = Table::new(0, [&[Words("variant")][..], &numbers, &words].concat());
    for run in &report.disturbed {
        let p99: Vec<_> = run.p99_ms.iter().map(|ms| format!("{ms:.2}")).collect();
        let (steal, missed) = (run.steal_ticks, run.missed_releases);
        table.add(cells![&run.cell, run.run, steal, missed, run.fate(), p99.join(", ")]);
    }
    Ok(table.html(out)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::TAUTLINE;
    use crate::report::tests::{report, row};

    #[test]
    fn the_page_is_whole_and_needs_nothing_else() {
        let mut rows = Vec::new();
        for variant in ["futures-rt", "futures-rt-mw-below", "nort-tokio"] {
            rows.extend((0..5).map(|index| row(TAUTLINE, variant, index, &[2.0, 60.0])));
        }
        rows.push(row(TAUTLINE, "capacity-15", 1, &[70.0]));
        let page = page(&report(rows)).unwrap();
        assert!(page.starts_with("<!doctype html>") && page.ends_with("</body></html>\n"));
        assert_eq!((page.matches("<svg ").count(), page.matches("</svg>").count()), (11, 11));
        assert!(!page.contains("src=") && !page.contains("@import") && !page.contains("<script"));
        assert!(
            page.contains("other variants that meet every deadline") && page.contains("a &lt;method&gt;")
        );
        assert!(page.contains("capacity-15"));
    }

    #[test]
    fn a_run_of_one_variant_is_a_page_too() {
        let page = page(&report(vec![row(TAUTLINE, "tokio", 0, &[])])).unwrap();
        assert_eq!(page.matches("<svg ").count(), 1);
    }
}
