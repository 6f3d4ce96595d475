// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report as one page that needs nothing else.

use std::fmt::Write;

use tautline_benches::page::{END, begin, escape, list, verdicts};
use tautline_paper::Variant;

use crate::Result;
use crate::figures::{ablation_histograms, p99_bars};
use crate::plan::Experiment;
use crate::report::Report;
use crate::stats::Row;

/// The page.
pub fn page(report: &Report) -> Result<String> {
    let variants = variants(&report.rows);
    let ablation: Vec<String> =
        variants.iter().filter(|(_, v)| is_of_ablation(*v)).map(|(n, _)| n.clone()).collect();
    let others: Vec<String> =
        variants.iter().filter(|(_, v)| !v.is_ablation()).map(|(n, _)| n.clone()).collect();
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
        out.push_str("<h2>Response times of all variants</h2>\n<figure>\n");
        out.push_str(&p99_bars(&report.rows, &others)?);
        out.push_str(
            "\n<figcaption>99th percentile of the response time, from scheduled release to end of callback, in ms. A bar that \
             ends in a triangle is longer than the scale.</figcaption></figure>\n",
        );
    }
    if ablation.len() > 1 {
        out.push_str("<h2>The middleware's priority</h2>\n<figure>\n");
        out.push_str(&ablation_histograms(&report.rows, &ablation)?);
        out.push_str(
            "\n<figcaption>futures-rt with sampler and middleware above the callbacks (21), below them (15), and without a \
             real-time priority: response times of topic 1, whose deadline is dashed.</figcaption></figure>\n<figure>\n",
        );
        out.push_str(&p99_bars(&report.rows, &ablation)?);
        out.push_str(
            "\n<figcaption>The same: 99th percentiles of all topics, in ms.</figcaption></figure>\n",
        );
    }
    write_capacity(&mut out, report)?;
    write_rows(&mut out, report)?;
    write_disturbed(&mut out, report)?;
    list(&mut out, "Method", &report.notes.method)?;
    list(&mut out, "Machine and versions", &report.notes.machine)?;
    out.push_str(END);
    Ok(out)
}

/// What was measured of the paper's variants, in the order of the rows.
fn variants(rows: &[Row]) -> Vec<(String, Variant)> {
    let mut found: Vec<(String, Variant)> = Vec::new();
    for row in rows {
        if let Experiment::Paper(variant) = row.cell.experiment
            && !found.iter().any(|(_, other)| *other == variant)
        {
            found.push((row.variant.clone(), variant));
        }
    }
    found
}

fn is_of_ablation(variant: Variant) -> bool {
    variant.is_ablation() || variant == Variant::FUTURES_RT
}

fn write_capacity(out: &mut String, report: &Report) -> Result<()> {
    let rows: Vec<_> =
        report.rows.iter().filter(|row| matches!(row.cell.experiment, Experiment::Capacity(_))).collect();
    if rows.is_empty() {
        return Ok(());
    }
    out.push_str(
        "<h2>Queue capacity</h2>\n<p>While <i>goal</i>'s callback computes, <i>scan</i> waits: its queue needs the computed \
         capacity, the larger number here. r2r is asked for as much.</p>\n<table><tr><th class=\"l\">system</th><th class=\"l\">queue</th><th class=\"l\">topic</th>\
         <th>runs</th><th>published</th><th>handled</th><th>lost</th><th>max ms</th><th>RTA ms</th></tr>\n",
    );
    for row in rows {
        let lost = if row.lost > 0 { " class=\"late\"" } else { "" };
        writeln!(
            out,
            "<tr><td class=\"l\">{}</td><td class=\"l\">{}</td><td class=\"l\">{}</td><td>{}</td><td>{}</td><td>{}</td>\
             <td{lost}>{}</td><td>{}</td><td>{}</td></tr>",
            row.system,
            row.variant,
            escape(&row.topic),
            row.runs,
            row.published,
            row.n,
            row.lost,
            time(row.max_ms),
            time(row.rta_ms)
        )?;
    }
    out.push_str("</table>\n");
    Ok(())
}

fn write_rows(out: &mut String, report: &Report) -> Result<()> {
    out.push_str(
        "<h2>All numbers</h2>\n<p>Times in ms. RTA+ is the prediction with the overhead that was measured.</p>\n<div class=\"scroll\">\
         <table><tr><th class=\"l\">variant</th><th class=\"l\">system</th><th class=\"l\">topic</th><th>runs</th><th>n</th>\
         <th>mean</th><th>p50</th><th>p99</th><th>±</th><th>max</th><th>RTA</th><th>RTA+</th><th>deadline</th><th>late</th>\
         <th>lost</th><th>steal ticks</th></tr>\n",
    );
    for row in &report.rows {
        let first = if row.index == 0 { " class=\"first\"" } else { "" };
        let mark = |count: u64| if count > 0 { " class=\"late\"" } else { "" };
        write!(out, "<tr{first}>")?;
        for word in [&row.variant, &row.system.to_string(), &row.topic] {
            write!(out, "<td class=\"l\">{}</td>", escape(word))?;
        }
        write!(out, "<td>{}</td><td>{}</td>", row.runs, row.n)?;
        let times = [
            row.mean_ms,
            row.p50_ms,
            row.p99_ms,
            row.p99_std_ms,
            row.max_ms,
            row.rta_ms,
            row.rta_overhead_ms,
        ];
        for ms in times {
            write!(out, "<td>{}</td>", time(ms))?;
        }
        writeln!(
            out,
            "<td>{}</td><td{}>{}</td><td{}>{}</td><td>{}</td></tr>",
            row.deadline_ms,
            mark(row.misses),
            row.misses,
            mark(row.lost),
            row.lost,
            row.steal_ticks
        )?;
    }
    out.push_str("</table></div>\n");
    Ok(())
}

fn write_disturbed(out: &mut String, report: &Report) -> Result<()> {
    out.push_str("<h2>Disturbed runs</h2>\n");
    if report.disturbed.is_empty() {
        out.push_str("<p>The hypervisor took the core from no run.</p>\n");
        return Ok(());
    }
    out.push_str(
        "<table><tr><th class=\"l\">variant</th><th>run</th><th>steal ticks</th><th>releases missed</th><th class=\"l\">then</th>\
         <th class=\"l\">p99 of each topic, ms</th></tr>\n",
    );
    for run in &report.disturbed {
        let fate = if run.replaced { "replaced by a repetition" } else { "counts nevertheless" };
        let p99: Vec<_> = run.p99_ms.iter().map(|ms| format!("{ms:.2}")).collect();
        writeln!(
            out,
            "<tr><td class=\"l\">{}</td><td>{}</td><td>{}</td><td>{}</td><td class=\"l\">{fate}</td><td class=\"l\">{}</td></tr>",
            escape(&run.cell),
            run.run,
            run.steal_ticks,
            run.missed_releases,
            p99.join(", ")
        )?;
    }
    out.push_str("</table>\n");
    Ok(())
}

fn time(ms: Option<f64>) -> String {
    ms.map_or(String::new(), |ms| format!("{ms:.2}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::System;
    use crate::report::tests::{report, row};

    #[test]
    fn the_page_is_whole_and_needs_nothing_else() {
        let mut rows = Vec::new();
        for variant in ["futures-rt", "futures-rt-mw-below", "nort-tokio"] {
            rows.extend((0..5).map(|index| row(System::Tautline, variant, index, &[2.0, 60.0])));
        }
        rows.push(row(System::Tautline, "capacity-15", 1, &[70.0]));
        let page = page(&report(rows)).unwrap();
        assert!(page.starts_with("<!doctype html>") && page.ends_with("</body></html>\n"));
        assert_eq!((page.matches("<svg ").count(), page.matches("</svg>").count()), (3, 3));
        assert!(!page.contains("src=") && !page.contains("@import") && !page.contains("<script"));
        assert!(page.contains("p99 is at most 1.01 x r2r's") && page.contains("a &lt;method&gt;"));
        assert!(page.contains("capacity-15"));
    }

    #[test]
    fn a_run_of_one_variant_is_a_page_too() {
        let page = page(&report(vec![row(System::Tautline, "tokio", 0, &[])])).unwrap();
        assert_eq!(page.matches("<svg ").count(), 1);
    }
}
