// SPDX-License-Identifier: MIT OR Apache-2.0
//! Groups with `order = "priority"`: a thread that always runs the waiting callback with the highest rank next. Bounds are compared with a
//! schedule that is worked out by hand, and with schedules of random systems, which a simulation of its own plays.

use rand::{Rng, RngExt};
use std::fmt::Write;
use tautline_analysis::file::SystemFile;

/// A callback of the group; times in microseconds.
#[derive(Debug)]
struct Callback {
    period: u64,
    wcet: u64,
    /// Its priority within the group.
    rank: u8,
}

/// The group's callbacks, and other threads on the core: (period, wcet, whether above the group).
#[derive(Debug)]
struct Case {
    group: Vec<Callback>,
    others: Vec<(u64, u64, bool)>,
}

const ABOVE: u8 = 60;
const BELOW: u8 = 20;

fn file(case: &Case) -> String {
    let mut text = String::from(
        "[hosts.robot]\ncores = 1\nsampler_priority = 90\n[nodes.n]\nclient = \"rclcpp\"\ncore = 0\n[nodes.m]\ncore = 0\n",
    );
    text += "[groups.g]\norder = \"priority\"\npriority = 40\n";
    for (i, callback) in case.group.iter().enumerate() {
        let Callback { period, wcet, rank } = callback;
        let _ = write!(
            text,
            "[callbacks.g{i}]\nnode = \"n\"\ngroup = \"g\"\nwcet = \"{wcet}us\"\ndeadline = \"3600s\"\n"
        );
        let _ = writeln!(
            text,
            "topic = \"/t{i}\"\npriority = {rank}\n[topics.\"/t{i}\"]\nperiod = \"{period}us\""
        );
    }
    for (i, (period, wcet, is_above)) in case.others.iter().enumerate() {
        let priority = if *is_above { ABOVE } else { BELOW } + i as u8;
        let _ = writeln!(
            text,
            "[callbacks.o{i}]\nnode = \"m\"\nperiod = \"{period}us\"\nwcet = \"{wcet}us\"\npriority = {priority}\ndeadline = \"3600s\""
        );
    }
    text
}

/// The bounds of the group's callbacks, in microseconds; `None` without one.
fn bounds(case: &Case) -> Vec<Option<u64>> {
    let text = file(case);
    let file = SystemFile::parse(&text).unwrap_or_else(|error| panic!("{error}\n{text}"));
    let checked = file.check().callbacks;
    case.group
        .iter()
        .enumerate()
        .map(|(i, _)| {
            let of = checked.iter().find(|callback| callback.entry.name == format!("g{i}")).unwrap();
            of.response_ns.map(|ns| ns / 1000)
        })
        .collect()
}

/// The longest response of each callback of the group until `until`, with these first releases: all at their whole wcet.
fn simulate(case: &Case, first: &[u64], until: u64) -> Vec<u64> {
    let group = case.group.len();
    let period = |i: usize| if i < group { case.group[i].period } else { case.others[i - group].0 };
    let wcet = |i: usize| if i < group { case.group[i].wcet } else { case.others[i - group].1 };
    let rank = |i: usize| case.group[i].rank;
    // Released and not ended: who, when, what is left.
    let mut ready: Vec<(usize, u64, u64)> = Vec::new();
    let mut next = first.to_vec();
    let mut longest = vec![0; group];
    // What was reported together, and is run before the thread waits again.
    let mut round: Vec<(usize, u64)> = Vec::new();
    for now in 0..until {
        for (i, next) in next.iter_mut().enumerate().filter(|(_, next)| **next == now) {
            ready.push((i, now, wcet(i)));
            *next += period(i);
        }
        if round.is_empty() {
            let of_group = || ready.iter().filter(|(i, ..)| *i < group);
            let highest = of_group().map(|(i, ..)| rank(*i)).max();
            let mut of_highest: Vec<_> = of_group().filter(|(i, ..)| Some(rank(*i)) == highest).collect();
            // One job of each, its oldest, in the order of creation.
            of_highest.sort_by_key(|(i, since, _)| (*i, *since));
            of_highest.dedup_by_key(|(i, ..)| *i);
            round = of_highest.into_iter().rev().map(|(i, since, _)| (*i, *since)).collect();
        }
        let chosen = round.last().and_then(|job| ready.iter().position(|(i, since, _)| (*i, *since) == *job));
        let other = |is_above: bool| {
            let of = ready
                .iter()
                .enumerate()
                .filter(|(_, (i, ..))| *i >= group && case.others[i - group].2 == is_above);
            of.max_by_key(|(_, (i, ..))| *i).map(|(at, _)| at)
        };
        let Some(at) = other(true).or(chosen).or(other(false)) else { continue };
        ready[at].2 -= 1;
        let (i, since, left) = ready[at];
        if left == 0 {
            if i < group {
                longest[i] = longest[i].max(now + 1 - since);
                round.pop();
            }
            ready.swap_remove(at);
        }
    }
    longest
}

#[test]
fn the_highest_waits_for_one_job_and_the_lowest_for_all() {
    let callback = |period, wcet, rank| Callback { period, wcet, rank };
    let case = Case {
        group: vec![callback(100, 10, 3), callback(100, 20, 2), callback(100, 30, 1)],
        others: vec![],
    };
    // 30 before it and 10 of its own; 30, 10 and 20; all three.
    assert_eq!(bounds(&case), [Some(40), Some(60), Some(60)]);
    // In rounds, each may be the last of all.
    let any = file(&case).replace("order = \"priority\"", "order = \"any\"");
    let any: String =
        any.lines().filter(|line| !line.starts_with("priority")).map(|line| format!("{line}\n")).collect();
    let checked = SystemFile::parse(&any).unwrap().check().callbacks;
    assert!(checked.iter().all(|callback| callback.response_ns == Some(60_000)));
    // Two of one rank are reported together, before a third one comes.
    let case =
        Case { group: vec![callback(100, 1, 3), callback(100, 20, 1), callback(100, 20, 1)], others: vec![] };
    assert_eq!(bounds(&case)[0], Some(41));
    // A thread above preempts all of it.
    let case = Case {
        group: vec![callback(100, 10, 2), callback(100, 30, 1)],
        others: vec![(50, 5, true), (1000, 500, false)],
    };
    assert_eq!(bounds(&case), [Some(45), Some(45)]);
}

#[test]
fn no_schedule_is_longer_than_its_bound() {
    let (mut random, mut compared, mut reached) = (tautline_seed::random(), 0, 0);
    for _ in 0..400 {
        let case = made_up(&mut random);
        let bounds = bounds(&case);
        let all = case.group.len() + case.others.len();
        let mut longest = vec![0; case.group.len()];
        for _ in 0..20 {
            let first: Vec<u64> = (0..all).map(|_| random.random_range(0..60)).collect();
            let found = simulate(&case, &first, 1500);
            longest.iter_mut().zip(found).for_each(|(longest, found)| *longest = found.max(*longest));
        }
        for (bound, longest) in bounds.iter().zip(&longest) {
            let Some(bound) = bound else { continue };
            assert!(longest <= bound, "{longest} > {bound}: {case:?}\n{bounds:?}");
            compared += 1;
            reached += u64::from(longest * 10 >= bound * 8);
        }
    }
    println!(
        "{compared} bounds, {reached} of them within a quarter above the longest response that was found"
    );
    assert!(compared > 500 && reached * 4 > compared, "{reached} of {compared}");
}

fn made_up(random: &mut impl Rng) -> Case {
    let mut left = 900;
    let mut share = |random: &mut dyn FnMut(u64) -> u64, period: u64| {
        let wcet = (1 + random(20)).min(left * period / 1000).max(1);
        left = left.saturating_sub(wcet * 1000 / period);
        wcet
    };
    let mut below = |most: u64| random.random_range(0..most);
    let group = (0..2 + below(4)).map(|_| {
        let period = 40 + below(100);
        let rank = 1 + below(4) as u8;
        Callback { period, wcet: share(&mut below, period), rank }
    });
    let group = group.collect();
    let others = (0..below(3)).map(|_| {
        let period = 40 + below(100);
        (period, share(&mut below, period), below(2) == 0)
    });
    Case { others: others.collect(), group }
}

#[test]
fn ranks_are_of_executors_of_ros() {
    let wrong = |from: &str, to: &str, why: &str| {
        let callback = |rank| Callback { period: 100, wcet: 1, rank };
        let case = Case { group: vec![callback(7), callback(6)], others: vec![] };
        let text = file(&case);
        assert!(text.contains(from), "{text}");
        let error = SystemFile::parse(&text.replacen(from, to, 1)).unwrap_err().to_string();
        assert!(error.contains(why), "{error}");
    };
    wrong(
        "client = \"rclcpp\"\n",
        "",
        "is run by Tautline, where each callback with a priority has a thread",
    );
    wrong("\npriority = 40", "", "orders its callbacks by their priorities: give it a `priority`, too");
    wrong("priority = 7\n", "", "callback `g0` of group `g` has no `priority`");
    let topic = "topic = \"/t1\"\npriority = 6\n[topics.\"/t1\"]\n";
    wrong(topic, "", "callback `g1` is a timer, which rcl runs beside the message that is reported");
}
