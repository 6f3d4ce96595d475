// SPDX-License-Identifier: MIT OR Apache-2.0
//! System files that say something without a meaning are refused, with its place; what only looks like it is not.
use tautline_analysis::file::SystemFile;

/// A timer of 10 ms, and what its topic triggers.
const GOOD: &str = r#"[hosts.robot]
cores = 1
[nodes.driver]
[callbacks.scan]
period = "10ms"
wcet = "2ms"
publishes = "/scan"
[callbacks.plan]
topic = "/scan"
wcet = "3ms"
[[chains]]
name = "all"
path = ["scan", "plan"]
deadline = "20ms"
"#;

/// The good file with one piece replaced.
fn with(piece: &str, replacement: &str) -> String {
    assert!(GOOD.contains(piece), "{piece}");
    GOOD.replacen(piece, replacement, 1)
}

/// Asserts that a file has exactly this problem, given by its line and a part of its text.
fn refuses(text: &str, line: usize, part: &str) {
    let found = SystemFile::parse(text).unwrap_err().to_string();
    assert!(found.starts_with(&format!("{line}:")) && found.contains(part), "{line}: {part}: {found}");
    assert_eq!(found.lines().count(), 1, "{found}");
}

#[test]
fn a_topic_that_is_listed_twice_does_not_count_twice() {
    assert!(SystemFile::parse(GOOD).unwrap().check().schedulable);
    refuses(
        &with("topic = \"/scan\"", "topic = [\"/scan\", \"/scan\"]"),
        9,
        "`topic` of callback `plan` lists topic `/scan` twice: list it once",
    );
    refuses(
        &with("publishes = \"/scan\"", "publishes = [\"/scan\", \"/map\", \"/scan\"]"),
        7,
        "`publishes` of callback `scan` lists topic `/scan` twice: list it once",
    );
    let reads = with("period = \"10ms\"", "period = \"10ms\"\nreads = [\"/scan\", \"/scan\"]");
    refuses(&reads, 6, "`reads` of callback `scan` lists topic `/scan` twice: list it once");
}

#[test]
fn a_chain_of_no_callbacks_meets_no_deadline() {
    refuses(
        &with("[\"scan\", \"plan\"]", "[]"),
        13,
        "`path` of chain `all` is empty: list the callbacks it passes",
    );
}
