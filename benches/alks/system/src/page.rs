// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paper's four figures and the drive, on a page.

use tautline_alks::picture;
use tautline_alks::records::Span;
use tautline_harness::page::{END, begin, figure, list, verdicts};
use tautline_harness::readings::table;
use tautline_harness::{Series, histogram};

use crate::Result;
use crate::report::Report;

/// What the paper's figures show.
const FIGURES: [(&str, &[Span]); 4] = [
    (
        "End-to-end latency of the odometry chain, and the duration of its first callback",
        &[Span::Chain, Span::Imu],
    ),
    ("Durations of the odometry's callbacks in ALKS and visualizer", &[Span::Odometry, Span::ShowOdometry]),
    ("Subscribers of the ALKS node: each callback, or run_until_stalled", &[Span::Subscriber, Span::Stalled]),
    ("The timer of the ALKS node: with and without planning", &[Span::Timer, Span::Planning]),
];

/// All reports as one HTML document.
pub fn page(reports: &[Report]) -> Result<String> {
    let (mut page, title) = (String::new(), "Automated lane keeping");
    let introduction = "A simulated car on a simulated motorway, three processes, eleven topics. Counts are on a logarithmic scale.";
    begin(&mut page, title, title, introduction)?;
    for report in reports {
        list(&mut page, &report.label(), &report.notes())?;
        table(&report.rows).html(&mut page)?;
        if !report.verdicts.is_empty() {
            verdicts(&mut page, "What must hold", &report.verdicts)?;
        }
        for (title, spans) in FIGURES {
            let times = report.times.iter().filter(|times| spans.contains(&times.span));
            let times: Vec<_> = times.map(|of| Series { name: &of.name, counts: &of.values }).collect();
            let bound = report.bounds.as_ref().filter(|_| spans.contains(&Span::Chain));
            let bound = bound.and_then(|bounds| bounds.of(Span::Chain));
            let bound = bound.map(|bound| ("bound", bound.as_secs_f64() * 1e3));
            if !times.is_empty() {
                figure(&mut page, &histogram(title, &times, bound)?, "")?;
            }
        }
        figure(&mut page, &picture::drive(&report.drive)?, "")?;
    }
    page.push_str(END);
    Ok(page)
}
