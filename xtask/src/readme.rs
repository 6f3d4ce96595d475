// SPDX-License-Identifier: MIT OR Apache-2.0
//! The README's tables and its picture, made from a run on this machine: no number in them is typed.

use crate::{bench, compare, network, paper, services, steps};
use serde_json::Value;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::process::{Command, ExitCode};

/// Where the picture goes.
const PICTURE: &str = "docs/demo.svg";
/// That of the comparison.
const COMPARISON: &str = "docs/compare.svg";

/// A part of the README that is made from a run.
#[derive(clap::ValueEnum, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Demo,
    Wake,
    Messages,
    Services,
    Parameters,
    Network,
    Paper,
    Compare,
}

impl Part {
    const ALL: [Part; 8] = [
        Part::Demo,
        Part::Wake,
        Part::Messages,
        Part::Services,
        Part::Parameters,
        Part::Network,
        Part::Paper,
        Part::Compare,
    ];

    /// Its mark in the README.
    fn mark(self) -> &'static str {
        match self {
            Part::Demo => "demo",
            Part::Wake => "wake",
            Part::Messages => "messages",
            Part::Services => "services",
            Part::Parameters => "parameters",
            Part::Network => "network",
            Part::Paper => "paper",
            Part::Compare => "compare",
        }
    }

    /// What measures it and writes `json`.
    fn command(self, quick: bool, json: &Path) -> Result<Command, String> {
        Ok(match self {
            Part::Demo => {
                let mut demo = steps::cargo("run --release -p taut -- demo --seconds 20 --svg");
                demo.arg(PICTURE).arg("--json").arg(json);
                demo
            }
            Part::Wake => bench("wake", quick, Some(json)),
            Part::Messages => bench("messages", quick, Some(json)),
            Part::Services => services::command(&services::Options {
                quick,
                json: Some(json.to_owned()),
                ..Default::default()
            }),
            Part::Parameters => bench("parameters", quick, Some(json)),
            Part::Network => network::command(&network::Options {
                quick,
                json: Some(json.to_owned()),
                ..Default::default()
            })?,
            Part::Compare => compare::command(&compare::Options {
                quick,
                json: Some(json.to_owned()),
                html: Some(json.with_extension("html")),
                arguments: vec!["--svg".to_owned(), COMPARISON.to_owned()],
                ..Default::default()
            }),
            Part::Paper => {
                // The whole evaluation takes two hours, this a quarter of one.
                let (runs, seconds) = if quick { (None, None) } else { (Some(3), Some(8.0)) };
                let (json, html) = (Some(json.to_owned()), Some(json.with_extension("html")));
                paper::command(&paper::Options { quick, runs, seconds, json, html, ..Default::default() })
            }
        })
    }

    fn table(self, run: &Value) -> String {
        match self {
            Part::Demo => demo_table(run),
            Part::Wake => wake_tables(run),
            Part::Messages => messages_table(run),
            Part::Services => services_table(run),
            Part::Parameters => parameters_tables(run),
            Part::Network => network_tables(run),
            Part::Paper => paper_table(run),
            Part::Compare => compare_tables(run),
        }
    }
}

/// Runs what the parts (none: all) are made from and puts them into the README. Measures first: no table is made of a run
/// that failed.
pub fn run(quick: bool, parts: &[Part]) -> ExitCode {
    let parts = if parts.is_empty() { &Part::ALL[..] } else { parts };
    let json = |part: &Part| format!("target/readme-{}.json", part.mark());
    for part in parts {
        let run = part.command(quick, json(part).as_ref()).and_then(|mut command| match command.status() {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => Err(status.to_string()),
            Err(error) => Err(error.to_string()),
        });
        if let Err(reason) = run {
            eprintln!("the README stays as it is: the run failed: {reason}");
            return ExitCode::FAILURE;
        }
    }
    let update = |part| update("README.md".as_ref(), part, json(&part).as_ref());
    match parts.iter().copied().try_for_each(update) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

/// Puts the tables of a run, as JSON, between their marks in `readme`.
fn update(readme: &Path, part: Part, json: &Path) -> Result<(), String> {
    let run = read_json(json)?;
    let text = fs::read_to_string(readme).map_err(|error| format!("{}: {error}", readme.display()))?;
    let text = replace(&text, part.mark(), &part.table(&run))?;
    fs::write(readme, text).map_err(|error| format!("{}: {error}", readme.display()))
}

fn read_json(path: &Path) -> Result<Value, String> {
    let text = fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
    serde_json::from_str(&text).map_err(|error| format!("{}: {error}", path.display()))
}

/// Replaces what stands between `<!-- mark:begin -->` and `<!-- mark:end -->`.
fn replace(text: &str, mark: &str, table: &str) -> Result<String, String> {
    let (begin, end) = (format!("<!-- {mark}:begin -->"), format!("<!-- {mark}:end -->"));
    let missing = || format!("the README has no {begin} ... {end}");
    let (before, rest) = text.split_once(&begin).ok_or_else(missing)?;
    let (_, after) = rest.split_once(&end).ok_or_else(missing)?;
    Ok(format!("{before}{begin}\n{table}{end}{after}"))
}

fn demo_table(demo: &Value) -> String {
    let mut out = String::from(
        "| topic | period ms | wcet ms | priority | n | p50 ms | p99 ms | max ms | RTA ms | RTA + overhead ms | missed | lost | max queue |\n\
         |---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    for topic in demo["topics"].as_array().into_iter().flatten() {
        let time = |key: &str| topic[key].as_f64().map_or("-".into(), |ms| format!("{ms:.2}"));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            topic["topic"].as_str().unwrap_or("?"),
            topic["period_ms"],
            topic["wcet_ms"],
            topic["priority"],
            topic["n"],
            time("p50_ms"),
            time("p99_ms"),
            time("max_ms"),
            time("rta_ms"),
            time("rta_overhead_ms"),
            topic["deadline_misses"],
            topic["lost"],
            topic["max_queue"],
        );
    }
    let _ = writeln!(
        out,
        "\n`taut demo`: {} s on one core, {:.1} µs of middleware per message, steal {} ticks; {}, {}.",
        demo["seconds"],
        demo["overhead_us"].as_f64().unwrap_or(f64::NAN),
        demo["steal_ticks"],
        machine(),
        demo["preemption"].as_str().unwrap_or("?"),
    );
    out
}

fn wake_tables(rows: &Value) -> String {
    let rows: Vec<&Value> = rows.as_array().into_iter().flatten().collect();
    let mut out = String::from(
        "64 B, from one process to another, half a round trip, in µs (p50 / p99 / p99.9 / max):\n\n\
         | system | idle states as shipped | idle states held off |\n|---|--:|--:|\n",
    );
    for (system, mode) in names(&rows) {
        let cell = |idle| {
            let row = find(&rows, system, mode, idle, 64, false);
            row.map_or("-".into(), |row| {
                format!(
                    "{} / {} / {} / {}",
                    us(row, "p50_us"),
                    us(row, "p99_us"),
                    us(row, "p999_us"),
                    us(row, "max_us")
                )
            })
        };
        let _ = writeln!(out, "| {system}, {mode} | {} | {} |", cell("default"), cell("poll"));
    }
    let sizes: [(u64, &str); 4] = [(64, "64 B"), (4 << 10, "4 KiB"), (1 << 20, "1 MiB"), (8 << 20, "8 MiB")];
    out.push_str("\nBy size, idle states held off, p50 in µs (payload untouched / all of it written and read):\n\n| system |");
    sizes.iter().for_each(|(_, name)| out.push_str(&format!(" {name} |")));
    out.push_str("\n|---|--:|--:|--:|--:|\n");
    for (system, mode) in names(&rows) {
        let _ = write!(out, "| {system}, {mode} |");
        for (bytes, _) in sizes {
            let p50 = |touched| {
                find(&rows, system, mode, "poll", bytes, touched).map_or("-".into(), |row| us(row, "p50_us"))
            };
            let _ = write!(out, " {} / {} |", p50(false), p50(true));
        }
        out.push('\n');
    }
    let lost: u64 = rows.iter().filter_map(|row| row["lost"].as_u64()).sum();
    let n: u64 = rows.iter().filter_map(|row| row["n"].as_u64()).sum();
    let _ = writeln!(
        out,
        "\n`cargo xtask bench wake`: two processes, FIFO 50, pinned, {n} round trips in alternating rounds, {lost} wake-ups \
         lost; {}. A bare futex is the floor for anything that sleeps; busy polling occupies a core. iceoryx2 alone is faster \
         where it polls: Tautline adds sequence numbers, time stamps, loss counters and a callback.",
        machine()
    );
    out
}

/// The 99th percentiles of the evaluation: a row for each variant, ours and r2r's for each topic.
fn paper_table(rows: &Value) -> String {
    let rows: Vec<&Value> = rows.as_array().into_iter().flatten().collect();
    let of_paper = |row: &&&Value| !row["variant"].as_str().unwrap_or("").starts_with("capacity");
    let (mut variants, mut topics) = (Vec::new(), Vec::new());
    for row in rows.iter().filter(of_paper) {
        if !variants.contains(&&row["variant"]) {
            variants.push(&row["variant"]);
        }
        if !topics.iter().any(|(topic, _)| *topic == &row["topic"]) {
            topics.push((&row["topic"], row["deadline_ms"].as_f64().unwrap_or(f64::NAN)));
        }
    }
    let mut out = String::from("| variant |");
    for (topic, deadline) in &topics {
        let _ = write!(out, " {} ({deadline}) |", topic.as_str().unwrap_or("?"));
    }
    out.push_str("\n|---|");
    topics.iter().for_each(|_| out.push_str("--:|"));
    out.push('\n');
    for variant in &variants {
        let _ = write!(out, "| {} |", variant.as_str().unwrap_or("?"));
        for (topic, _) in &topics {
            let cell = |system: &str| {
                let wanted = |row: &&&Value| {
                    row["system"] == system && row["variant"] == **variant && row["topic"] == **topic
                };
                let row = rows.iter().find(wanted)?;
                let mark = if row["misses"] == 0 && row["lost"] == 0 { "" } else { "*" };
                Some(format!("{}{mark}", us(row, "p99_ms")))
            };
            let cells: Vec<_> = ["tautline", "r2r"].into_iter().filter_map(cell).collect();
            let _ = write!(out, " {} |", cells.join(" / "));
        }
        out.push('\n');
    }
    let most = |key: &str| rows.iter().filter_map(|row| row[key].as_u64()).max().unwrap_or(0);
    let _ = writeln!(
        out,
        "\n`cargo xtask bench paper`: 99th percentiles in ms, Tautline / r2r 0.9.7 over Fast DDS, deadlines in brackets; \
         \\* marks missed deadlines or lost messages; {} runs of {:.0} s of each variant, of which the hypervisor took at most \
         {} ticks of 10 ms from one variant; {}.",
        most("runs"),
        rows.first().map_or(f64::NAN, |row| run_seconds(row)),
        most("steal_ticks"),
        machine()
    );
    out
}

/// A topic's period is its deadline.
fn run_seconds(row: &Value) -> f64 {
    let number = |key: &str| row[key].as_f64().unwrap_or(f64::NAN);
    number("n") * number("deadline_ms") / 1e3 / number("runs")
}

/// The comparison: a line for each way of each system.
fn compare_tables(run: &Value) -> String {
    let rows: Vec<&Value> = run.as_array().into_iter().flatten().collect();
    let measured: Vec<&Value> = rows.iter().copied().filter(|row| row["n"] != 0).collect();
    let find = |experiment: &str, (system, mode): (&str, &str), bytes: u64| {
        measured.iter().copied().find(|row| {
            row["experiment"] == experiment
                && row["system"] == system
                && row["mode"] == mode
                && row["payload_bytes"] == bytes
        })
    };
    let held = "latency/whole/held-off";
    let both = |row: &Value| format!("{} / {}", us(row, "p50_us"), us(row, "p99_us"));
    type Cell<'a> = (&'a str, &'a str, u64, &'a dyn Fn(&Value) -> String);
    let columns: [Cell; 6] = [
        ("64 B", held, 64, &both),
        ("1 MiB", held, 1 << 20, &both),
        ("8 MiB", held, 8 << 20, &both),
        ("1 kHz under load, p99.9", "open-loop/load/held-off", 1024, &|row| us(row, "p999_us")),
        ("robot: CPU", "robot/20x100Hz", 4096, &|row| us(row, "cpu_us_per_msg")),
        ("robot: MiB", "robot/20x100Hz", 4096, &|row| us(row, "rss_mib")),
    ];
    let mut out = String::from("| system |");
    columns.iter().for_each(|(title, ..)| out.push_str(&format!(" {title} |")));
    let _ = writeln!(out, "\n|---|{}", "--:|".repeat(columns.len()));
    for name in names(&measured) {
        let cells = columns
            .map(|(_, experiment, bytes, text)| find(experiment, name, bytes).map_or("-".into(), text));
        if cells.iter().any(|cell| cell != "-") {
            let _ = writeln!(out, "| {}, {} | {} |", name.0, name.1, cells.join(" | "));
        }
    }
    let mut missing: Vec<String> = Vec::new();
    for row in rows.iter().filter(|row| row["experiment"] == "-") {
        let word = |key: &str| row[key].as_str().unwrap_or("?");
        let text = format!("{}, {} ({})", word("system"), word("mode"), word("note"));
        if !missing.contains(&text) {
            missing.push(text);
        }
    }
    let missing =
        if missing.is_empty() { String::new() } else { format!(" Left out: {}.", missing.join("; ")) };
    let _ = writeln!(
        out,
        "\n`cargo xtask bench compare`: half round trips in µs (p50 / p99), payload written and read whole, idle states held \
         off for all, FIFO 50, pinned; one way at 1 kHz under load; 20 topics at 100 Hz: CPU time of all processes per message \
         in µs and resident memory; {}.{missing}",
        machine()
    );
    out
}

/// Systems and modes in the order in which they first appear.
fn names<'r>(rows: &[&'r Value]) -> Vec<(&'r str, &'r str)> {
    let mut names = Vec::new();
    for row in rows {
        if let (Some(system), Some(mode)) = (row["system"].as_str(), row["mode"].as_str())
            && !names.contains(&(system, mode))
        {
            names.push((system, mode));
        }
    }
    names
}

fn find<'r>(
    rows: &[&'r Value],
    system: &str,
    mode: &str,
    idle: &str,
    bytes: u64,
    touched: bool,
) -> Option<&'r Value> {
    let wanted = |row: &&&Value| {
        row["system"] == system
            && row["mode"] == mode
            && row["idle"] == idle
            && row["payload_bytes"] == bytes
            && row["touched"] == touched
    };
    rows.iter().find(wanted).copied()
}

/// A line per message, a column per way to handle it.
fn messages_table(run: &Value) -> String {
    let rows: Vec<_> = run.as_array().into_iter().flatten().collect();
    let names = |key: &str| {
        let mut names: Vec<_> = rows.iter().filter_map(|row| row[key].as_str()).collect();
        let mut seen = std::collections::BTreeSet::new();
        names.retain(|name| seen.insert(*name));
        names
    };
    let implementations = names("implementation");
    let mut out = format!("| message | bytes | {} |\n", implementations.join(" | "));
    let _ = writeln!(out, "|---|--:|{}", "--:|".repeat(implementations.len()));
    for case in names("case") {
        let find = |implementation: &str| {
            rows.iter().find(|row| row["case"] == case && row["implementation"] == implementation)
        };
        let bytes = find(implementations[0]).map_or(&Value::Null, |row| &row["bytes"]);
        let time = |row: &&Value| match row["p50_us"].as_f64() {
            Some(us) if us < 1.0 => format!("{us:.3}"),
            _ => us(row, "p50_us"),
        };
        let times = implementations.iter().map(|name| find(name).map_or("-".into(), time));
        let _ = writeln!(out, "| {case} | {bytes} | {} |", times.collect::<Vec<_>>().join(" | "));
    }
    let _ =
        writeln!(out, "\n`cargo xtask bench messages`: medians in µs, one process, one core; {}.", machine());
    out
}

/// A line per way to ask and length of the request.
fn services_table(run: &Value) -> String {
    let mut out = String::from(
        "| round trip in µs | bytes asked | n | p50 | p99 | p99.9 | max | lost |\n|---|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    for row in run["rows"].as_array().into_iter().flatten() {
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} | {} | {} |",
            row["system"].as_str().unwrap_or("?"),
            row["request_bytes"],
            row["n"],
            us(row, "p50_us"),
            us(row, "p99_us"),
            us(row, "p999_us"),
            us(row, "max_us"),
            row["lost"],
        );
    }
    let _ = writeln!(
        out,
        "\n`cargo xtask bench services`: two processes, FIFO 50, each on a core, both blocking, alternating rounds, answers of 64 \
         bytes; in place nothing is copied, r2r's requests are a text that is; {}; {}.",
        run["versions"].as_str().unwrap_or("?"),
        machine()
    );
    out
}

/// What a read costs, and what a thread that sets does to a callback.
fn parameters_tables(run: &Value) -> String {
    let rows: Vec<&Value> = run.as_array().into_iter().flatten().collect();
    let of = |experiment: &str| -> Vec<&Value> {
        rows.iter().copied().filter(|row| row["experiment"] == experiment).collect()
    };
    let mut out = String::from("| read | ns | ns, while it is set |\n|---|--:|--:|\n");
    let ns = |row: &Value| row["p50_us"].as_f64().map_or("-".into(), |us| format!("{:.1}", us * 1e3));
    for row in of("read") {
        let Some(what) = row["mode"].as_str().and_then(|mode| mode.strip_suffix(", not being set")) else {
            continue;
        };
        let being_set = format!("{what}, being set");
        let other = rows.iter().find(|row| row["mode"].as_str() == Some(&being_set));
        let _ = writeln!(out, "| {what} | {} | {} |", ns(row), other.map_or("-".into(), |row| ns(row)));
    }
    out.push_str(
        "\n| 1 kHz callback, meanwhile | p50 µs | p99 µs | p99.9 µs | max µs | p99 to the quiet one's |\n\
         |---|--:|--:|--:|--:|--:|\n",
    );
    for row in of("callback") {
        let ratio = |at: usize| row["ratio"][at].as_f64().unwrap_or(f64::NAN);
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {:.2} ({:.2} to {:.2}) |",
            row["mode"].as_str().unwrap_or("?"),
            us(row, "p50_us"),
            us(row, "p99_us"),
            us(row, "p999_us"),
            us(row, "max_us"),
            ratio(0),
            ratio(1),
            ratio(2),
        );
    }
    let jobs: u64 = of("callback").iter().filter_map(|row| row["n"].as_u64()).sum();
    let disturbance = rows.first().and_then(|row| row["disturbance"].as_str()).unwrap_or("?");
    let _ = writeln!(
        out,
        "\n`cargo xtask bench parameters`: medians of rounds; {jobs} jobs in alternating rounds, the callback FIFO 40 on one core, the \
         other thread, 10,000 times a second, on another; {disturbance}; {}.",
        machine()
    );
    out
}

/// Round trips and streams, a line per system, a column per payload; and the callbacks.
fn network_tables(run: &Value) -> String {
    let rows: Vec<&Value> = run.as_array().into_iter().flatten().collect();
    let of = |experiment: &str| -> Vec<&Value> {
        rows.iter().copied().filter(|row| row["experiment"] == experiment).collect()
    };
    let mut out = String::new();
    type Number = fn(&Value) -> String;
    let columns: [(&str, &str, Number); 2] = [
        ("round-trip", "half a round trip in µs, p50 / p99", |row| {
            format!("{} / {}", us(row, "p50_us"), us(row, "p99_us"))
        }),
        ("stream", "a stream in MB/s", |row| {
            row["mb_per_s"].as_f64().map_or("-".into(), |rate| format!("{rate:.0}"))
        }),
    ];
    for (experiment, title, number) in columns {
        let rows = of(experiment);
        let mut sizes: Vec<u64> = rows.iter().filter_map(|row| row["payload_bytes"].as_u64()).collect();
        sizes.sort_unstable();
        sizes.dedup();
        let _ = write!(out, "| {title} |");
        for bytes in &sizes {
            let (number, unit) = match bytes {
                1_048_576.. => (bytes >> 20, "MiB"),
                1024.. => (bytes >> 10, "KiB"),
                _ => (*bytes, "B"),
            };
            let _ = write!(out, " {number} {unit} |");
        }
        let _ = writeln!(out, "\n|---|{}", "--:|".repeat(sizes.len()));
        for (system, mode) in names(&rows) {
            let _ = write!(out, "| {system}, {mode} |");
            for bytes in &sizes {
                let wanted = |row: &&&Value| {
                    row["system"] == system && row["mode"] == mode && row["payload_bytes"] == *bytes
                };
                let _ = write!(out, " {} |", rows.iter().find(wanted).map_or("-".into(), |row| number(row)));
            }
            out.push('\n');
        }
        out.push('\n');
    }
    let callbacks = of("callbacks");
    let p99 = |mode: &str| {
        let rows =
            callbacks.iter().filter(|row| row["mode"].as_str().is_some_and(|name| name.starts_with(mode)));
        rows.map(|row| row["p99_us"].as_f64().map_or("-".into(), |us| format!("{:.2}", us / 1e3)))
            .collect::<Vec<_>>()
            .join(" / ")
    };
    let arrived = callbacks.iter().find_map(|row| row["mb_per_s"].as_f64()).unwrap_or(0.0);
    let _ = writeln!(
        out,
        "p99 response times in ms of five real-time callbacks that load a core to 90 %: {} alone, {} while {arrived:.0} MB/s \
         arrive for another topic.",
        p99("quiet"),
        p99("flood"),
    );
    let lost: u64 =
        rows.iter().filter(|row| row["system"] == "tautline").filter_map(|row| row["lost"].as_u64()).sum();
    let hiroz = if rows.iter().any(|row| row["system"] == "hiroz") { " and hiroz" } else { "" };
    let _ = writeln!(
        out,
        "\n`cargo xtask bench network`: from a node over two gateways to a node, beside Zenoh's own publishers and \
         subscribers{hiroz}, TCP over loopback, two processes, each with its gateway on a core, alternating rounds; {lost} messages of \
         Tautline's lost; {}.",
        machine()
    );
    out
}

/// Three figures are enough.
fn us(row: &Value, key: &str) -> String {
    match row[key].as_f64() {
        Some(us) if us < 100.0 => format!("{us:.2}"),
        Some(us) => format!("{us:.0}"),
        None => "-".into(),
    }
}

fn machine() -> String {
    let cpuinfo = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = cpuinfo
        .lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(": "))
        .map_or("?", |m| m.1);
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let virtual_machine = if cpuinfo.contains(" hypervisor") { ", virtual machine" } else { "" };
    format!("{model}, {cores} cores{virtual_machine}, Linux {}", kernel.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_evaluations_table_has_both_systems_and_marks_what_failed() {
        let row = |system: &str, topic: &str, p99_ms: f64, misses: u64| {
            serde_json::json!({"system": system, "variant": "tokio", "topic": topic, "deadline_ms": 10.0,
                               "p99_ms": p99_ms, "misses": misses, "lost": 0, "runs": 3, "n": 600,
                               "steal_ticks": 1})
        };
        let rows = [row("tautline", "a", 2.0, 0), row("tautline", "b", 3.0, 0), row("r2r", "a", 123.4, 5)];
        let table = paper_table(&rows.to_vec().into());
        let lines: Vec<_> = table.lines().take(3).collect();
        assert_eq!(
            lines,
            ["| variant | a (10) | b (10) |", "|---|--:|--:|", "| tokio | 2.00 / 123* | 3.00 |"]
        );
        assert!(table.contains("3 runs of 2 s of each"), "{table}");
        assert!(table.contains("at most 1 ticks"));
    }

    #[test]
    fn the_parameters_tables_have_reads_and_the_callback() {
        let row = |experiment: &str, mode: &str, us: f64, ratio: Value| {
            serde_json::json!({"experiment": experiment, "system": "tautline", "mode": mode, "p50_us": us, "n": 10,
                               "p99_us": 2.0 * us, "ratio": ratio, "disturbance": "steal 3 ticks"})
        };
        let rows = [
            row("read", "f64, not being set", 0.0031, Value::Null),
            row("read", "f64, being set", 0.0052, Value::Null),
            row("callback", "quiet", 10.0, serde_json::json!([1.0, 1.0, 1.0])),
            row("callback", "a thread sets", 10.5, serde_json::json!([1.05, 0.97, 1.2])),
        ];
        let tables = parameters_tables(&rows.to_vec().into());
        for line in [
            "| f64 | 3.1 | 5.2 |\n",
            "| quiet | 10.00 | 20.00 | - | - | 1.00 (1.00 to 1.00) |\n",
            "| a thread sets | 10.50 | 21.00 | - | - | 1.05 (0.97 to 1.20) |\n",
            "20 jobs in alternating rounds",
            "steal 3 ticks",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }

    #[test]
    fn the_networks_tables_have_a_column_per_payload() {
        let row = |experiment: &str, system: &str, mode: &str, bytes: u64, us: f64| {
            serde_json::json!({"experiment": experiment, "system": system, "mode": mode, "payload_bytes": bytes,
                               "p50_us": us, "p99_us": 2.0 * us, "mb_per_s": 700.4, "lost": 0})
        };
        let rows = [
            row("round-trip", "zenoh", "pub-sub", 64, 40.0),
            row("round-trip", "zenoh", "pub-sub", 1 << 20, 400.0),
            row("round-trip", "tautline", "node-to-node", 64, 50.0),
            row("stream", "zenoh", "window", 64 << 10, 1.0),
            row("callbacks", "tautline", "quiet a", 0, 2000.0),
            row("callbacks", "tautline", "flood a", 1 << 20, 2100.0),
        ];
        let tables = network_tables(&rows.to_vec().into());
        for line in [
            "| half a round trip in µs, p50 / p99 | 64 B | 1 MiB |\n|---|--:|--:|",
            "| zenoh, pub-sub | 40.00 / 80.00 | 400 / 800 |",
            "| tautline, node-to-node | 50.00 / 100 | - |",
            "| a stream in MB/s | 64 KiB |\n|---|--:|\n| zenoh, window | 700 |",
            "90 %: 4.00 alone, 4.20 while 700 MB/s",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }

    #[test]
    fn the_comparisons_table_has_a_line_per_way_and_names_what_is_left_out() {
        let row = |experiment: &str, system: &str, bytes: u64, n: u64| {
            serde_json::json!({"experiment": experiment, "system": system, "mode": "m", "payload_bytes": bytes, "n": n,
                               "p50_us": 5.0, "p99_us": 50.0, "p999_us": 500.0, "cpu_us_per_msg": 40.0,
                               "rss_mib": 12.0, "note": "not measured: why"})
        };
        let held = "latency/whole/held-off";
        let rows = [
            row(held, "tautline", 64, 9),
            row("robot/20x100Hz", "tautline", 4096, 9),
            row(held, "fastdds", 64, 9),
            row(held, "fastdds", 1 << 20, 0),
            row("latency/untouched/held-off", "hiroz", 64, 9),
            row("-", "copper", 0, 0),
        ];
        let tables = compare_tables(&rows.to_vec().into());
        for line in [
            "| tautline, m | 5.00 / 50.00 | - | - | - | 40.00 | 12.00 |",
            "| fastdds, m | 5.00 / 50.00 | - | - | - | - | - |",
            "Left out: copper, m (not measured: why).",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
        assert!(!tables.contains("hiroz"), "it has none of these numbers\n{tables}");
    }

    #[test]
    fn the_services_table_says_what_was_lost_and_with_which_versions() {
        let run = serde_json::json!({"versions": "r2r 0.9.7", "rows": [
            {"system": "r2r over Fast DDS", "request_bytes": 64, "n": 10, "p50_us": 123.4, "p99_us": 5.0, "p999_us": 6.0,
             "max_us": 7.0, "lost": 2}]});
        let table = services_table(&run);
        assert!(table.contains("| r2r over Fast DDS | 64 | 10 | 123 | 5.00 | 6.00 | 7.00 | 2 |"), "{table}");
        assert!(table.contains("r2r 0.9.7"), "{table}");
    }

    #[test]
    fn only_what_is_between_the_marks_changes() {
        let text = "a\n<!-- demo:begin -->\nold\n<!-- demo:end -->\nb\n";
        let new = replace(text, "demo", "table\n").unwrap();
        assert_eq!(new, "a\n<!-- demo:begin -->\ntable\n<!-- demo:end -->\nb\n");
        assert!(replace(text, "wake", "").unwrap_err().contains("wake:begin"));
    }
}
