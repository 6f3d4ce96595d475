// SPDX-License-Identifier: MIT OR Apache-2.0
//! The timeline of the critical instant as SVG: which job has each core when all are released at once.
use std::fmt::Write;

use crate::demo::plot::shorten;
use tautline_analysis::file::{CheckedCallback, CheckedCore, CheckedSystem};
use tautline_analysis::timeline::{Timeline, critical_instant};

const WIDTH: f64 = 1_000.0;
const LEFT: f64 = 170.0;
const RIGHT: f64 = 960.0;
const ROW: f64 = 30.0;
const BAR: f64 = 16.0;
const TITLE: f64 = 84.0;
const PANEL_HEAD: f64 = 34.0;
const AXIS: f64 = 44.0;

/// The maximum number of bars; more would not be legible.
const MOST_RUNS: usize = 4_000;

const STYLE: &str = "text{font-family:system-ui,sans-serif;font-size:12px;fill:#222831}.t{font-size:20px;font-weight:600}\
.h{font-size:14px;font-weight:600}.f{fill:#666e7a}.n{text-anchor:end}.m{text-anchor:middle}.run{fill:#4c84c4}\
.over{fill:#8a93a0}.late{fill:#e25242}.wait{fill:#dbe6f3}.g{stroke:#e2e6eb}.r{stroke:#d68600;stroke-width:2}\
.d{stroke:#cc2026;stroke-width:2}.up{stroke:#222831;stroke-width:1.2}";

/// Draws all cores, one below the other, each over the time until its last first job has ended.
pub fn draw(checked: &CheckedSystem) -> String {
    let rows = |core: &CheckedCore| members(checked, core).len() + usize::from(has_overhead(core));
    let panel = |core: &CheckedCore| PANEL_HEAD + ROW * rows(core) as f64 + AXIS;
    let height = TITLE + checked.cores.iter().map(panel).sum::<f64>();
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" width=\"{WIDTH}\" \
         height=\"{height}\"><style>{STYLE}</style><rect width=\"{WIDTH}\" height=\"{height}\" fill=\"#fff\"/>\n"
    );
    text(&mut svg, 24.0, 32.0, "t", "Critical instant: everything is released at once");
    legend(&mut svg);
    let mut top = TITLE;
    for core in &checked.cores {
        draw_core(&mut svg, checked, core, top);
        top += panel(core);
    }
    svg.push_str("</svg>\n");
    svg
}

fn legend(svg: &mut String) {
    let mut x = 24.0;
    let y = 58.0;
    for (class, label) in [
        ("run", "running"),
        ("wait", "preempted or waiting"),
        ("late", "past its deadline"),
        ("over", "messages and ticks"),
        ("up", "release"),
        ("r", "response-time bound"),
        ("d", "deadline"),
    ] {
        match class {
            "up" | "r" | "d" => line(svg, x + 6.0, y - 10.0, x + 6.0, y + 2.0, class),
            _ => rect(svg, x, y - 9.0, 12.0, 10.0, class),
        }
        text(svg, x + 18.0, y, "f", label);
        x += 34.0 + 6.6 * label.len() as f64;
    }
}

/// The callbacks of a core, by falling priority, each with the indices of its tasks on that core.
fn members<'c>(checked: &'c CheckedSystem, core: &CheckedCore) -> Vec<(&'c CheckedCallback, Vec<usize>)> {
    let here = checked.callbacks.iter().filter(|c| c.host == core.host && c.core == core.number);
    let tasks = |callback: &CheckedCallback| {
        let named = |i: &usize| core.tasks[*i].name == callback.entry.name;
        (0..core.tasks.len()).filter(named).collect()
    };
    let mut members: Vec<_> = here.map(|callback| (callback, tasks(callback))).collect();
    members.sort_by_key(|(callback, _)| std::cmp::Reverse(callback.entry.running_priority()));
    members
}

fn has_overhead(core: &CheckedCore) -> bool {
    let messages =
        core.tasks.iter().any(|task| task.message_overhead_ns.unwrap_or(core.overheads.per_message_ns) > 0);
    messages || core.overheads.tick_ns > 0 && core.overheads.tick_period_ns > 0
}

/// The length of the timeline: until all first jobs have ended, and all bounds are visible.
fn horizon(core: &CheckedCore, members: &[(&CheckedCallback, Vec<usize>)]) -> (u64, Timeline) {
    let bounds = members.iter().filter_map(|(callback, _)| callback.response_overhead_ns).max().unwrap_or(0);
    let longest = core.tasks.iter().map(|task| task.period_ns).max().unwrap_or(1);
    let unbounded = members.iter().any(|(callback, _)| callback.response_overhead_ns.is_none());
    // Deadlines not much later than the bounds are shown, too.
    let deadlines = members.iter().map(|(callback, _)| callback.entry.deadline_ns);
    let deadline =
        deadlines.filter(|deadline| *deadline <= bounds.saturating_add(bounds / 4)).max().unwrap_or(0);
    let wanted = if unbounded { longest.saturating_mul(2) } else { bounds.max(deadline) };
    let shortest = core.tasks.iter().map(|task| task.wcet_ns).min().unwrap_or(1);
    let until = wanted.saturating_add(wanted / 25).max(shortest).max(1);
    // Draws as many jobs as fit.
    let rate: f64 = core.tasks.iter().map(|task| 1.0 / task.period_ns as f64).sum();
    let until = until.min((MOST_RUNS as f64 / rate) as u64).max(1);
    (until, critical_instant(&core.tasks, &core.overheads, until))
}

fn draw_core(svg: &mut String, checked: &CheckedSystem, core: &CheckedCore, top: f64) {
    let members = members(checked, core);
    let (until, timeline) = horizon(core, &members);
    let x = |ns: u64| LEFT + (RIGHT - LEFT) * ns.min(until) as f64 / until as f64;
    let overhead = has_overhead(core);
    let rows = members.len() + usize::from(overhead);
    let head = format!("{}, core {}: {:.1} %", core.host, core.number, core.utilisation * 100.0);
    text(svg, 24.0, top + 18.0, "h", &head);
    let (first, bottom) = (top + PANEL_HEAD, top + PANEL_HEAD + ROW * rows as f64);
    axis(svg, until, first, bottom, x);
    if overhead {
        text(svg, LEFT - 10.0, first + 19.0, "n f", "sampler, ticks");
        for run in timeline.runs.iter().filter(|run| run.task.is_none()) {
            rect(svg, x(run.start_ns), first + 7.0, (x(run.end_ns) - x(run.start_ns)).max(0.6), BAR, "over");
        }
    }
    for (row, (callback, tasks)) in members.iter().enumerate() {
        let y = first + ROW * (row + usize::from(overhead)) as f64;
        let priority = crate::table::priority(callback.entry.running_priority());
        let label = format!("{} ({priority})", shorten(&callback.entry.name, 18));
        text(svg, LEFT - 10.0, y + 19.0, "n", &label);
        for job in timeline.jobs.iter().filter(|job| tasks.contains(&job.task)) {
            let end = job.end_ns.unwrap_or(until);
            rect(svg, x(job.release_ns), y + 9.0, x(end) - x(job.release_ns), BAR - 4.0, "wait");
        }
        for run in timeline.runs.iter().filter(|run| run.task.is_some_and(|task| tasks.contains(&task))) {
            rect(svg, x(run.start_ns), y + 7.0, x(run.end_ns) - x(run.start_ns), BAR, "run");
        }
        let deadline = callback.entry.deadline_ns;
        for job in timeline.jobs.iter().filter(|job| tasks.contains(&job.task)) {
            let (end, due) = (job.end_ns.unwrap_or(until), job.release_ns.saturating_add(deadline));
            let due = if job.release_ns == 0 { due.saturating_sub(callback.jitter_ns) } else { due };
            if end > due {
                rect(svg, x(due), y + 20.0, x(end) - x(due), 3.0, "late");
            }
            line(svg, x(job.release_ns), y + 3.0, x(job.release_ns), y + 26.0, "up");
        }
        for (time, class) in [(callback.response_overhead_ns, "r"), (Some(deadline), "d")] {
            // The first job's nominal release lies its jitter before the critical instant.
            let time = time.map(|time| time.saturating_sub(callback.jitter_ns));
            if let Some(time) = time.filter(|time| *time <= until) {
                line(svg, x(time), y + 3.0, x(time), y + 27.0, class);
            }
        }
    }
}

/// Time in milliseconds, at steps of 1, 2 or 5.
fn axis(svg: &mut String, until: u64, top: f64, bottom: f64, x: impl Fn(u64) -> f64) {
    let mut step: u64 = 1;
    for factor in [2, 5, 10].into_iter().cycle() {
        if until / step <= 16 {
            break;
        }
        let decade = 10_u64.pow(step.ilog10());
        step = decade * factor;
    }
    for k in 0..=until / step {
        let at = k * step;
        line(svg, x(at), top, x(at), bottom, "g");
        text(svg, x(at), bottom + 16.0, "m f", &format!("{}", at as f64 / 1e6));
    }
    text(svg, RIGHT, bottom + 30.0, "n f", "ms after the critical instant");
    line(svg, LEFT, bottom, RIGHT, bottom, "g");
}

fn rect(svg: &mut String, x: f64, y: f64, width: f64, height: f64, class: &str) {
    // Writing to a string cannot fail.
    let _ = writeln!(
        svg,
        "<rect class=\"{class}\" x=\"{x:.2}\" y=\"{y:.2}\" width=\"{width:.2}\" height=\"{height}\"/>"
    );
}

fn line(svg: &mut String, x1: f64, y1: f64, x2: f64, y2: f64, class: &str) {
    let _ = writeln!(
        svg,
        "<line class=\"{class}\" x1=\"{x1:.2}\" y1=\"{y1:.2}\" x2=\"{x2:.2}\" y2=\"{y2:.2}\"/>"
    );
}

fn text(svg: &mut String, x: f64, y: f64, class: &str, text: &str) {
    let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    let _ = writeln!(svg, "<text class=\"{class}\" x=\"{x:.2}\" y=\"{y:.2}\">{text}</text>");
}
