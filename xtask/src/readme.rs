// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tables and pictures of the README and of the documents, made from a run on this machine: no number in them is typed.

mod comparison;
mod demo;

use crate::bench::{self, Name};
use crate::build::Build;
use crate::files::{self, read};
use crate::machine::target_dir;
use crate::steps::{self, execute};
use crate::word;
use clap::ValueEnum;
use std::ops::Range;
use std::path::Path;
use std::process::Command;

/// Where the picture goes.
const PICTURE: &str = "docs/demo.svg";
/// The comparison on docs.rs.
const CRATE_PAGE: &str = "node/src/comparison.md";
/// That of the comparison.
const COMPARISON: &str = "docs/compare.svg";

/// A part of the documents that is made from a run, by its mark there: the demo and benches.
#[derive(ValueEnum, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Demo,
    Wake,
    Messages,
    Services,
    Parameters,
    Network,
    Paper,
    Compare,
    Domain,
    Rmw,
}

impl Part {
    /// Where its mark is.
    fn document(self) -> &'static str {
        match self {
            Part::Demo => "docs/demo.md",
            Part::Rmw => "docs/rmw.md",
            Part::Domain => "docs/adr/0007-the-graph-and-topics-are-files.md",
            _ => "docs/benchmarks.md",
        }
    }

    /// What measures it and writes `json`, and its tables beside.
    fn command(self, quick: bool, minutes: Option<u64>, json: &Path) -> Result<Command, String> {
        if self == Part::Demo {
            let mut demo = steps::cargo("run --release -p taut -- demo --seconds 20 --svg");
            demo.arg(PICTURE).arg("--json").arg(json);
            return Ok(demo);
        }
        let file = |ending| json.with_extension(ending).display().to_string();
        let mut told = vec!["--json".to_owned(), file("json"), "--markdown".to_owned(), file("md")];
        if quick {
            told.push("--quick".to_owned());
        }
        if matches!(self, Part::Wake | Part::Services | Part::Network | Part::Compare | Part::Paper) {
            told.extend(["--html".to_owned(), file("html")]);
        }
        if self == Part::Compare {
            told.extend(["--svg", COMPARISON].map(str::to_owned));
        }
        if self == Part::Paper && !quick {
            // The whole evaluation takes two hours: what was begun is gone on with.
            told.extend(["--results".to_owned(), file("runs")]);
            told.extend(minutes.map(|minutes| format!("--minutes={minutes}")));
        }
        bench::command(Name::from_str(&word(self), false)?, &told, Build::Release)
    }

    /// The tables of a run that wrote `json`.
    fn tables(self, json: &Path) -> Result<String, String> {
        if self != Part::Demo {
            return read(&json.with_extension("md"));
        }
        let demo = serde_json::from_str(&read(json)?);
        Ok(demo::table(&demo.map_err(|error| format!("{}: {error}", json.display()))?))
    }
}

/// Runs what the parts (none: all) are made from and puts them into their documents. Measures first: no table is made of a run
/// that failed.
pub fn run(quick: bool, minutes: Option<u64>, parts: &[Part]) -> Result<(), String> {
    let parts = if parts.is_empty() { Part::value_variants() } else { parts };
    let json = |part: &Part| target_dir().join(format!("readme-{}.json", word(*part)));
    for part in parts {
        let run = part.command(quick, minutes, &json(part)).and_then(|mut command| execute(&mut command));
        run.map_err(|reason| format!("the documents stay as they are: the run failed: {reason}"))?;
    }
    parts.iter().try_for_each(|part| update(part.document().as_ref(), *part, &json(part)))
}

/// Puts the tables of a run between their marks in `document`, and the comparison's excerpt into the first pages.
fn update(document: &Path, part: Part, json: &Path) -> Result<(), String> {
    let tables = part.tables(json)?;
    write(document, &word(part), &tables)?;
    match part {
        Part::Compare => {
            let excerpt = comparison::excerpt(&tables)?;
            ["README.md", CRATE_PAGE].iter().try_for_each(|page| write(page.as_ref(), "comparison", &excerpt))
        }
        _ => Ok(()),
    }
}

fn write(document: &Path, mark: &str, table: &str) -> Result<(), String> {
    let text = replace(&read(document)?, mark, table)?;
    files::write(document, text)
}

/// Replaces what stands between the marks.
fn replace(text: &str, mark: &str, table: &str) -> Result<String, String> {
    let range = marked(text, mark)?;
    Ok(format!("{}\n{table}{}", &text[..range.start], &text[range.end..]))
}

/// Where the text between `<!-- mark:begin -->` and `<!-- mark:end -->` is.
fn marked(text: &str, mark: &str) -> Result<Range<usize>, String> {
    let (begin, end) = (format!("<!-- {mark}:begin -->"), format!("<!-- {mark}:end -->"));
    let missing = || format!("the document has no {begin} ... {end}");
    let start = text.find(&begin).ok_or_else(missing)? + begin.len();
    let len = text[start..].find(&end).ok_or_else(missing)?;
    Ok(start..start + len)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_but_the_demo_is_a_bench() {
        let parts = Part::value_variants().iter().filter(|part| **part != Part::Demo);
        parts.for_each(|part| assert!(Name::from_str(&word(*part), false).is_ok(), "{}", word(*part)));
    }

    #[test]
    fn only_what_is_between_the_marks_changes() {
        let text = "a\n<!-- demo:begin -->\nold\n<!-- demo:end -->\nb\n";
        let new = replace(text, "demo", "table\n").unwrap();
        assert_eq!(new, "a\n<!-- demo:begin -->\ntable\n<!-- demo:end -->\nb\n");
        assert!(replace(text, "wake", "").unwrap_err().contains("wake:begin"));
    }
}
