// SPDX-License-Identifier: MIT OR Apache-2.0
//! System files that nobody wrote: mutations of the cases and examples, whose seed is printed. None panics; what is wrong is said with a place
//! in the text, and what is analysed has a bound or a warning.

use std::fmt::Write;

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use tautline_analysis::file::SystemFile;

const FILES: [&str; 12] = [
    include_str!("../../examples/systems/two-hosts.toml"),
    include_str!("../../examples/systems/reserved.toml"),
    include_str!("../../examples/systems/fusion.toml"),
    include_str!("../../examples/systems/groups.toml"),
    include_str!("cases/stall_and_throttling.toml"),
    include_str!("cases/demoted_with_lock.toml"),
    include_str!("cases/floating_reservation.toml"),
    include_str!("cases/gateway_of_three.toml"),
    include_str!("cases/join_in_group.toml"),
    include_str!("cases/rclcpp_group.toml"),
    include_str!("cases/no_cores.toml"),
    include_str!("cases/tail_and_throttling.toml"),
];

/// Values at the edges of what is allowed, and beyond.
const VALUES: [&str; 24] = [
    "0",
    "-1",
    "1",
    "99",
    "100",
    "255",
    "4096",
    "9223372036854775807",
    "1.5",
    "true",
    "[]",
    "{}",
    "[0, -1]",
    "[0, 0]",
    "\"\"",
    "\"0ns\"",
    "\"1ns\"",
    "\"1ms\"",
    "\"18446744073709551614ns\"",
    "\"18446744073709551615ns\"",
    "\"1000000000s\"",
    "\"any\"",
    "\"\\u001b[31m\"",
    "nan",
];

const KEYS: [&str; 20] = [
    "period",
    "wcet",
    "bcet",
    "deadline",
    "jitter",
    "min_distance",
    "non_preemptive",
    "priority",
    "core",
    "group",
    "overrun",
    "publishes",
    "reads",
    "topic",
    "all",
    "window",
    "policy",
    "take",
    "cores",
    "stall",
];

fn mutated(text: &str, rng: &mut StdRng) -> String {
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    for _ in 0..rng.random_range(1..=2) {
        let at = rng.random_range(0..lines.len().max(1)).min(lines.len().saturating_sub(1));
        match rng.random_range(0..7) {
            0 => lines.push(lines[at].clone()),
            1 if lines.len() > 1 => drop(lines.remove(at)),
            2 => {
                let other = rng.random_range(0..lines.len());
                lines.swap(at, other);
            }
            3 => {
                let line = format!(
                    "{} = {}",
                    KEYS[rng.random_range(0..KEYS.len())],
                    VALUES[rng.random_range(0..VALUES.len())]
                );
                lines.insert(at + 1, line);
            }
            4 => {
                let key = lines[at].split_once(" = ").map(|(key, _)| key.to_owned());
                let value = VALUES[rng.random_range(0..VALUES.len())];
                lines[at] = key.map_or_else(|| lines[at].clone(), |key| format!("{key} = {value}"));
            }
            5 => {
                // Another digit.
                let mut line: Vec<char> = lines[at].chars().collect();
                let digits: Vec<usize> = (0..line.len()).filter(|i| line[*i].is_ascii_digit()).collect();
                if !digits.is_empty() {
                    line[digits[rng.random_range(0..digits.len())]] =
                        char::from(b'0' + rng.random_range(0..10));
                }
                lines[at] = line.into_iter().collect();
            }
            _ => {
                let mut bytes = lines[at].clone().into_bytes();
                if !bytes.is_empty() {
                    let byte = rng.random_range(0..bytes.len());
                    bytes[byte] = rng.random_range(0..128);
                }
                lines[at] = String::from_utf8_lossy(&bytes).into_owned();
            }
        }
    }
    lines.join("\n")
}

#[test]
fn no_file_panics() {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut analysed, mut refused) = (0, 0);
    for round in 0..4_000 {
        let text = mutated(FILES[round % FILES.len()], &mut rng);
        let outcome = std::panic::catch_unwind(|| verdict(&text));
        match outcome.unwrap_or_else(|_| panic!("seed {seed}, round {round}:\n{text}")) {
            true => analysed += 1,
            false => refused += 1,
        }
    }
    println!("{analysed} analysed, {refused} refused");
    assert!(analysed > 400 && refused > 400, "{analysed}, {refused}");
}

/// Whether a file is analysed, or refused with a reason that can be shown.
fn verdict(text: &str) -> bool {
    match SystemFile::parse(text) {
        Ok(file) => {
            let checked = file.check();
            let has_all = checked.callbacks.iter().all(|callback| callback.response_overhead_ns.is_some());
            assert!(
                has_all || (!checked.schedulable && !checked.warnings.is_empty()),
                "{:?}",
                checked.warnings
            );
            assert!(checked.warnings.iter().all(|warning| !warning.chars().any(char::is_control)));
            true
        }
        Err(problems) => {
            let mut shown = String::new();
            for problem in &problems.0 {
                assert!(problem.line <= text.lines().count() + 1, "{problem:?}");
                writeln!(shown, "{}", problem.message).unwrap();
            }
            assert!(
                !problems.0.is_empty() && shown.lines().all(|line| !line.chars().any(char::is_control)),
                "{shown:?}"
            );
            false
        }
    }
}
