// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long the analysis of large systems takes: `cargo run --release -p tautline-analysis --example scale`.

use std::fmt::Write;
use std::time::Instant;

use tautline_analysis::file::SystemFile;

fn main() {
    let head = "[hosts.h]\ncores = 4\n[overheads]\nper_message = \"10ns\"\n[nodes.n]\ncore = 0\n[nodes.m]\ncore = 1\n";
    // Chains of as many callbacks, on one core or on two.
    let chains = |count: usize, length: usize, cores: usize| {
        let mut text = head.to_owned();
        for i in 0..count {
            let trigger = match i % length {
                0 => format!("period = \"{}ms\"", 100 + i / length),
                _ => format!("topic = \"t{}\"", i - 1),
            };
            let node = ["n", "m"][i % cores];
            writeln!(text, "[callbacks.c{i}]\nnode = \"{node}\"\n{trigger}\nwcet = \"100ns\"\npublishes = \"t{i}\"\ndeadline = \"1s\"\npriority = {}\nshares_priority = true", 1 + i % 80).unwrap();
        }
        text
    };
    let unknown = |count: usize| {
        let mut text = head.to_owned();
        for i in 0..count {
            writeln!(text, "[callbacks.c{i}]\nnode = \"n\"\ntopic = \"topic{i}\"\nwcet = \"1us\"\npublishes = \"tpoic{i}\"").unwrap();
        }
        text
    };
    let group = chains(10_000, 1, 1)
        .lines()
        .filter(|line| !line.contains("priority"))
        .collect::<Vec<_>>()
        .join("\n")
        .replace("wcet", "group = \"g\"\nwcet")
        + "\n[groups.g]\n";
    for (name, text) in [
        ("1,000 in one chain on one core", chains(1_000, 1_000, 1)),
        ("10,000 in one chain on one core", chains(10_000, 10_000, 1)),
        ("10,000 in one chain on two cores", chains(10_000, 10_000, 2)),
        ("10,000 in chains of ten", chains(10_000, 10, 2)),
        ("10,000 of their own on one core", chains(10_000, 1, 1)),
        ("10,000 in one group", group),
        ("3,000 unknown topics", unknown(3_000)),
    ] {
        let start = Instant::now();
        let parsed = SystemFile::parse(&text);
        let read = start.elapsed();
        let verdict = match &parsed {
            Ok(file) => format!("schedulable: {}", file.check().schedulable),
            Err(problems) => format!("{} problems", problems.0.len()),
        };
        println!("{name}: {:.2?}, of it {read:.2?} to read; {verdict}", start.elapsed());
    }
}
