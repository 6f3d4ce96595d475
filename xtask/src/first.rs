// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a user waits for first: the build of `cargo run --release -- demo` on a fresh clone. How much it is, and how much of it is one thing after the
//! other.

use crate::steps::{Steps, cargo_with, execute};
use crate::{machine, shared};
use serde_json::Value;
use std::collections::HashMap;
use std::fs;

/// Crates and build scripts that it may build.
const UNITS: usize = 300;

/// What it must not wait for: libraries of single verbs, which are programs of their own.
const NOT_FIRST: [&str; 8] =
    ["zenoh ", "rusqlite ", "libsqlite3-sys ", "zstd-sys ", "lz4-sys ", "mcap ", "ratatui ", "jaq-core "];

/// Of all work, in percent, that may be on the critical path: with two cores, a path of more than half of the work is what the build takes, whatever
/// else is left out. As a share it is the same on a fast machine and a slow one, idle or loaded.
const ON_PATH: f64 = 50.0;

/// How many units of the path are printed, those that take longest.
const SHOWN: usize = 10;

/// Checks how many units there are, then builds them.
pub fn test(steps: &mut Steps) {
    steps.step("first command: units", check_units);
    steps.step("first command: critical path", build);
}

/// Whether it builds as few units as it did.
fn check_units() -> Result<(), String> {
    let units = shared::units("build --release")?;
    if let Some(unit) = units.iter().find(|unit| NOT_FIRST.iter().any(|name| unit.name.starts_with(name))) {
        return Err(format!(
            "`cargo run --release -- demo` builds {}: give it to the program of the verb that needs it (cli/)",
            unit.name
        ));
    }
    println!("`cargo run --release -- demo` builds {} of at most {UNITS} units", units.len());
    match units.len() {
        0..=UNITS => Ok(()),
        count => {
            Err(format!("{count} units, {UNITS} are the limit: `cargo build --release --timings` lists them"))
        }
    }
}

/// Builds it as on a fresh clone, keeps cargo's report as `cargo-timings/first-command.html`, and checks the critical path.
fn build() -> Result<(), String> {
    let target = machine::target_dir();
    let (fresh, kept) = (target.join("first-command"), target.join("cargo-timings"));
    let say = |error: std::io::Error| format!("{}: {error}", fresh.display());
    if fresh.exists() {
        fs::remove_dir_all(&fresh).map_err(say)?;
    }
    let folder = format!("--target-dir={}", fresh.display());
    execute(&mut cargo_with("build --release --locked", ["--timings".to_owned(), folder]))?;
    let report = fs::read_to_string(fresh.join("cargo-timings/cargo-timing.html")).map_err(say)?;
    fs::create_dir_all(&kept)
        .and_then(|()| fs::write(kept.join("first-command.html"), &report))
        .map_err(say)?;
    fs::remove_dir_all(&fresh).map_err(say)?;
    check_path(&report)
}

/// Whether the critical path of a report of cargo's is within its limit.
fn check_path(report: &str) -> Result<(), String> {
    let (path, work) = critical_path(&units(report)?);
    let length: f64 = path.iter().map(|(_, seconds)| seconds).sum();
    let percent = 100.0 * length / work;
    println!(
        "{} units wait for one another: {length:.1} s of {work:.1} s of work, {percent:.0} %; longest:",
        path.len()
    );
    let mut longest: Vec<_> = path.iter().enumerate().collect();
    longest.sort_by(|(_, one), (_, other)| other.1.total_cmp(&one.1));
    longest.truncate(SHOWN);
    longest.sort_by_key(|(place, _)| *place);
    longest.iter().for_each(|(_, (name, seconds))| println!("{seconds:6.1} s  {name}"));
    if percent <= ON_PATH {
        return Ok(());
    }
    Err(format!(
        "{percent:.0} % of the first command's build is one unit after the other, {ON_PATH:.0} % are the limit: let one of these wait for less"
    ))
}

/// What cargo's report says of each unit. It is a page with a line of JSON for its pictures.
fn units(report: &str) -> Result<Vec<Value>, String> {
    let json = report.split_once("UNIT_DATA = ").ok_or("cargo's report has no UNIT_DATA")?.1;
    let mut values = serde_json::Deserializer::from_str(json).into_iter();
    let units: Option<Result<Vec<Value>, _>> = values.next();
    units.ok_or("UNIT_DATA is empty")?.map_err(|error| format!("UNIT_DATA: {error}"))
}

/// The units that waited for one another and took longest together, each with the seconds after which the next could begin; and the seconds of all
/// units. A unit is known to wait for one alone, that which it was started after: other paths may be as long, but none is made up.
fn critical_path(units: &[Value]) -> (Vec<(String, f64)>, f64) {
    let seconds = |value: &Value| value.as_f64().unwrap_or(0.0);
    let begin = |unit: &Value| seconds(&unit["start"]);
    let mut order: Vec<&Value> = units.iter().collect();
    order.sort_by(|one, other| begin(one).total_cmp(&begin(other)));
    // By the unit's number: what it waited for, with the seconds, and the seconds of the path up to its begin.
    let mut waited: HashMap<u64, (u64, f64)> = HashMap::new();
    let mut before: HashMap<u64, f64> = HashMap::new();
    let number = |unit: &Value| unit["i"].as_u64().unwrap_or_default();
    for unit in &order {
        let (number, duration) = (number(unit), seconds(&unit["duration"]));
        let begun = before.get(&number).copied().unwrap_or(0.0);
        // Libraries wait for a library's metadata alone, which is there before its code.
        let frontend =
            unit["sections"].as_array().into_iter().flatten().find(|section| section[0] == "frontend");
        let metadata = frontend.map_or(duration, |section| seconds(&section[1]["end"]));
        for (list, part) in [("unblocked_units", duration), ("unblocked_rmeta_units", metadata)] {
            for next in unit[list].as_array().into_iter().flatten().filter_map(Value::as_u64) {
                waited.insert(next, (number, part));
                before.insert(next, begun + part);
            }
        }
    }
    let end = |unit: &&Value| before.get(&number(unit)).unwrap_or(&0.0) + seconds(&unit["duration"]);
    let by_number: HashMap<u64, &Value> = units.iter().map(|unit| (number(unit), unit)).collect();
    let name = |unit: &Value| {
        let [name, version, target] =
            ["name", "version", "target"].map(|field| unit[field].as_str().unwrap_or_default());
        format!("{name} {version}{target}")
    };
    let mut path = Vec::new();
    let last = units.iter().max_by(|one, other| end(one).total_cmp(&end(other)));
    let mut next = last.map(|unit| (number(unit), seconds(&unit["duration"])));
    while let Some((unit, part)) = next {
        path.push((by_number.get(&unit).map_or_else(String::new, |unit| name(unit)), part));
        next = waited.get(&unit).copied();
    }
    path.reverse();
    (path, units.iter().map(|unit| seconds(&unit["duration"])).sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A macro, a library that waits for it, another one beside, and a program that waits for the metadata of both.
    fn report(program: f64, beside: f64) -> String {
        let unit = |i: u64, name: &str, start: f64, duration: f64, metadata: Option<f64>, next: &[u64]| {
            let sections = metadata.map(|end| serde_json::json!([["frontend", {"start": 0.0, "end": end}], ["codegen", {"start": end, "end": duration}]]));
            let (all, early) = if metadata.is_some() { (&[][..], next) } else { (next, &[][..]) };
            serde_json::json!({"i": i, "name": name, "version": "1.0.0", "target": "", "start": start, "duration": duration,
                "sections": sections, "unblocked_units": all, "unblocked_rmeta_units": early})
        };
        let units = serde_json::json!([
            unit(7, "macro", 0.0, 2.0, None, &[3]),
            unit(3, "library", 2.0, 5.0, Some(3.0), &[9]),
            unit(4, "beside", 0.0, beside, Some(1.0), &[]),
            unit(9, "program", 5.5, program, None, &[]),
        ]);
        format!("<script>\nconst UNIT_DATA = {units};\nconst CONCURRENCY_DATA = [];</script>")
    }

    #[test]
    fn the_critical_path_goes_by_what_is_waited_for() {
        let (path, work) = critical_path(&units(&report(4.0, 8.5)).unwrap());
        let path: Vec<_> = path.iter().map(|(name, seconds)| (name.as_str(), *seconds)).collect();
        assert_eq!(path, [("macro 1.0.0", 2.0), ("library 1.0.0", 3.0), ("program 1.0.0", 4.0)]);
        assert_eq!(work, 19.5);
    }

    #[test]
    fn more_than_half_of_the_work_in_a_row_is_too_much() {
        check_path(&report(4.0, 8.5)).unwrap();
        let fault = check_path(&report(8.0, 8.5)).unwrap_err();
        assert!(fault.starts_with("55 % of the first command's build"), "{fault}");
    }

    #[test]
    fn a_report_without_units_is_an_error() {
        assert!(check_path("<html></html>").unwrap_err().contains("no UNIT_DATA"));
        assert!(check_path("const UNIT_DATA = [{];").unwrap_err().contains("UNIT_DATA: "));
    }
}
