// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a user waits for first: the build of `cargo run --release -- demo` on a fresh clone. How much it is, and how much of it is one thing after the
//! other.

use crate::build::Build;
use crate::steps::{Steps, cargo_with, execute};
use crate::{files, machine, shared};
use serde_json::Value;

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

/// Builds it as on a fresh clone, keeps cargo's report as `cargo-timings/first-command.html`, and checks the critical path. Where nothing was
/// built for release yet, as in CI, what it builds stays for later steps.
fn build() -> Result<(), String> {
    let target = machine::target_dir();
    let kept = target.join("cargo-timings/first-command.html");
    let is_first = !Build::Release.folder().exists();
    let folder = if is_first { target } else { target.join("first-command") };
    let say = files::at(&folder);
    if !is_first {
        files::remove(&folder).map_err(say)?;
    }
    let told = format!("--target-dir={}", folder.display());
    execute(&mut cargo_with("build --release --locked", ["--timings".to_owned(), told]))?;
    let report = files::read(&folder.join("cargo-timings/cargo-timing.html"))?;
    files::write(&kept, &report)?;
    if !is_first {
        files::remove(&folder).map_err(say)?;
    }
    check_path(&report, &shared::unit_graph("build --release --locked")?)
}

/// Whether the critical path of a build is within its limit, by cargo's report of it and the graph of its units.
fn check_path(report: &str, graph: &[Value]) -> Result<(), String> {
    let units = Unit::read(report, graph)?;
    let work: f64 = units.iter().map(|unit| unit.seconds).sum();
    let path = critical_path(&units);
    let length: f64 = path.iter().map(|(_, seconds)| seconds).sum();
    let percent = 100.0 * length / work;
    println!(
        "{} units wait for one another: {length:.1} s of {work:.1} s of work, {percent:.0} %; longest, in order:",
        path.len()
    );
    let mut longest: Vec<_> = path.iter().enumerate().collect();
    longest.sort_by(|(_, one), (_, other)| other.1.total_cmp(&one.1));
    longest.truncate(SHOWN);
    longest.sort_by_key(|(place, _)| *place);
    longest.iter().for_each(|(_, (unit, seconds))| println!("{seconds:6.1} s  {}", unit.name));
    if percent <= ON_PATH {
        return Ok(());
    }
    Err(format!(
        "{percent:.0} % of the first command's build is one unit after the other, {ON_PATH:.0} % are the limit: let one of these wait for less"
    ))
}

/// A crate or a build script that is compiled, or a build script that is run.
struct Unit {
    name: String,
    seconds: f64,
    /// Until there is what a library needs of it to be compiled: of a library that is its metadata.
    seconds_for_libraries: f64,
    /// Whether it is linked, for which others must be there with all of their code.
    links: bool,
    needs: Vec<usize>,
}

impl Unit {
    /// What cargo's report says, a page with a line of JSON for its pictures, and its graph, in whose order the report has numbered them.
    fn read(report: &str, graph: &[Value]) -> Result<Vec<Unit>, String> {
        let json = report.split_once("UNIT_DATA = ").ok_or("cargo's report has no UNIT_DATA")?.1;
        let data: Option<Result<Vec<Value>, _>> = serde_json::Deserializer::from_str(json).into_iter().next();
        let data = data.ok_or("UNIT_DATA is empty")?.map_err(|error| format!("UNIT_DATA: {error}"))?;
        let said = |number| data.iter().find(|unit| unit["i"] == number);
        graph.iter().enumerate().map(|(number, unit)| Unit::of(said(number), unit)).collect()
    }

    fn of(said: Option<&Value>, unit: &Value) -> Result<Unit, String> {
        let id = unit["pkg_id"].as_str().unwrap_or_default();
        let text = |field| said.and_then(|said| said[field].as_str()).unwrap_or_default();
        // A build that was not made anew, or another one.
        if text("name").is_empty() || !id.contains(text("name")) {
            return Err(format!("cargo's report does not say how long {id} took"));
        }
        let seconds = |value: Option<&Value>| value.and_then(Value::as_f64).unwrap_or(0.0);
        let all = seconds(said.map(|said| &said["duration"]));
        let sections = said.and_then(|said| said["sections"].as_array());
        let frontend = sections.and_then(|sections| sections.iter().find(|section| section[0] == "frontend"));
        let is = |kind: &str| {
            unit["target"]["kind"].as_array().is_some_and(|kinds| kinds.iter().any(|one| one == kind))
        };
        let links = is("bin") || is("custom-build") || is("proc-macro");
        Ok(Unit {
            name: format!("{} {}{}", text("name"), text("version"), text("target")),
            seconds: all,
            seconds_for_libraries: if links {
                all
            } else {
                frontend.map_or(all, |found| seconds(Some(&found[1]["end"])))
            },
            links,
            needs: shared::needs(unit).collect(),
        })
    }
}

/// The units that wait for one another and take longest together, each with the seconds after which the next may begin: so long the build takes on a
/// machine with as many cores as it likes.
fn critical_path(units: &[Unit]) -> Vec<(&Unit, f64)> {
    let mut begins = vec![None; units.len()];
    let end = |index: usize, begins: &mut [_]| begin(units, index, begins).0 + units[index].seconds;
    let last =
        (0..units.len()).max_by(|one, other| end(*one, &mut begins).total_cmp(&end(*other, &mut begins)));
    let mut next = last.map(|index| (index, units[index].seconds));
    let mut path = Vec::new();
    while let Some((index, seconds)) = next {
        path.push((&units[index], seconds));
        next = begin(units, index, &mut begins).1;
    }
    path.reverse();
    path
}

/// When a unit may begin, the one that it waits for last, and the seconds of it that it waits for.
type Begin = (f64, Option<(usize, f64)>);

fn begin(units: &[Unit], index: usize, known: &mut [Option<Begin>]) -> Begin {
    if let Some(begin) = known[index] {
        return begin;
    }
    let mut latest: Begin = (0.0, None);
    for &need in &units[index].needs {
        let part = if units[index].links { units[need].seconds } else { units[need].seconds_for_libraries };
        let ready = begin(units, need, known).0 + part;
        if ready > latest.0 {
            latest = (ready, Some((need, part)));
        }
    }
    *known[index].insert(latest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// A macro, a library that waits for it, one beside, and a program that waits for the code of both and is last.
    fn build(program: f64, beside: f64) -> (String, Vec<Value>) {
        let unit = |i: u64, name: &str, duration: f64, metadata: Option<f64>| {
            let sections = metadata.map(|end| json!([["frontend", {"start": 0.0, "end": end}], ["codegen", {"start": end, "end": duration}]]));
            json!({"i": i, "name": name, "version": "1.0.0", "target": "", "duration": duration, "sections": sections})
        };
        let units = json!([
            unit(3, "macro", 2.0, None),
            unit(2, "library", 5.0, Some(3.0)),
            unit(1, "beside", beside, Some(1.0)),
            unit(4, "verbs", 1.5, Some(1.0)),
            unit(0, "program", program, None),
        ]);
        let node = |name: &str, kind: &str, needs: &[u64]| {
            let needs: Vec<_> = needs.iter().map(|index| json!({"index": index})).collect();
            json!({"pkg_id": format!("path+file:///{name}#1.0.0"), "target": {"kind": [kind]}, "mode": "build", "dependencies": needs})
        };
        let graph = vec![
            node("program", "bin", &[4, 1]),
            node("beside", "lib", &[]),
            node("library", "lib", &[3]),
            node("macro", "proc-macro", &[]),
            node("verbs", "lib", &[2]),
        ];
        (format!("<script>\nconst UNIT_DATA = {units};\nconst CONCURRENCY_DATA = [];</script>"), graph)
    }

    #[test]
    fn libraries_wait_for_metadata_and_programs_for_code() {
        let path_of = |(report, graph): (String, Vec<Value>)| {
            let units = Unit::read(&report, &graph).unwrap();
            critical_path(&units)
                .into_iter()
                .map(|(unit, seconds)| (unit.name.clone(), seconds))
                .collect::<Vec<_>>()
        };
        let named = |path: &[(&str, f64)]| {
            path.iter().map(|(name, seconds)| (format!("{name} 1.0.0"), *seconds)).collect::<Vec<_>>()
        };
        assert_eq!(
            path_of(build(4.0, 6.0)),
            named(&[("macro", 2.0), ("library", 3.0), ("verbs", 1.5), ("program", 4.0)])
        );
        assert_eq!(path_of(build(4.0, 6.6)), named(&[("beside", 6.6), ("program", 4.0)]));
    }

    #[test]
    fn more_than_half_of_the_work_in_a_row_is_too_much() {
        let check = |(report, graph): (String, Vec<Value>)| check_path(&report, &graph);
        check(build(2.0, 6.5)).unwrap();
        let fault = check(build(9.0, 6.5)).unwrap_err();
        assert!(fault.starts_with("65 % of the first command's build"), "{fault}");
    }

    #[test]
    fn a_report_of_another_build_is_an_error() {
        let (report, graph) = build(1.0, 1.0);
        let fault = |report: &str| check_path(report, &graph).unwrap_err();
        assert!(fault("<html></html>").contains("no UNIT_DATA"));
        assert!(fault("const UNIT_DATA = [{];").contains("UNIT_DATA: "));
        assert!(fault(&report.replace("verbs", "other")).contains("how long path+file:///verbs#1.0.0 took"));
    }
}
