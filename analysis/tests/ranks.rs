// SPDX-License-Identifier: MIT OR Apache-2.0
//! Groups with `order = "priority"`: a thread that always runs the waiting callback with the highest rank next. Bounds are compared with a
//! schedule that is worked out by hand; runtime.rs has random systems.

use std::fmt::Write;
use tautline_analysis::file::{CallbackEntry, SystemFile, ThreadPriority};

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

/// The bound of a callback, in microseconds, in a group that goes by ranks, of the nodes `m` and `n`. It also has `log`, of which two messages
/// may be there at once.
fn bound_beside_log(client: &str, callbacks: &str, name: &str) -> u64 {
    let text = format!(
        "[hosts.robot]\ncores = 1\n[nodes]\nm = {{ client = \"{client}\" }}\nn = {{ client = \"{client}\" }}\n\
         [groups.g]\norder = \"priority\"\npriority = 40\n\
         [topics]\nlog = {{ period = \"100us\", jitter = \"90us\" }}\nscan = {{ period = \"100us\" }}\n\
         [callbacks]\nlog = {{ node = \"m\", group = \"g\", topic = \"log\", priority = 1, wcet = \"10us\", deadline = \"1s\" }}\n{callbacks}"
    );
    let file = SystemFile::parse(&text).unwrap_or_else(|error| panic!("{error}\n{text}"));
    let checked = file.check().callbacks;
    checked.iter().find(|of| of.entry.name == name).and_then(|of| of.response_ns).unwrap() / 1000
}

/// Five messages of `burst` are there at 0, which the executor runs until 50. Those of `other` come just after 0, 10, ... to a thread of the same priority: it
/// has five at 50, and catches up at 74. `scan` comes just after 50 and is run until 75.
#[test]
fn a_thread_of_the_same_priority_may_have_waited_for_lower_ranks() {
    let more = "burst = { node = \"m\", group = \"g\", topic = \"burst\", priority = 2, wcet = \"10us\", deadline = \"1s\" }\n\
                other = { node = \"o\", topic = \"other\", priority = 40, wcet = \"3us\", deadline = \"1s\", shares_priority = true }\n\
                scan = { node = \"n\", group = \"g\", topic = \"scan\", priority = 3, wcet = \"1us\", shares_priority = true }\n\
                [topics.other]\nperiod = \"10us\"\n[topics.burst]\nperiod = \"100us\"\njitter = \"400us\"\n[nodes.o]\n";
    assert!(bound_beside_log("rclcpp", more, "scan") >= 75 - 50);
}

/// `fuse` has taken messages of both topics, stamped 0 and 5, when two more, both stamped 100, are found by a wait at 100. The first of them shows that
/// nothing fits the old ones better, and the second completes a set of its own: after two takes and two sets, at 122, `scan` is run, which came just after
/// the wait.
#[test]
fn a_join_makes_two_sets_in_a_round() {
    let more = "fuse = { node = \"n\", group = \"g\", all = [\"a\", \"b\"], window = \"10us\", take = \"1us\", priority = 2, wcet = \"10us\" }\n\
                scan = { node = \"n\", group = \"g\", topic = \"scan\", priority = 3, wcet = \"1us\" }\n\
                [topics.a]\nperiod = \"100us\"\n[topics.b]\nperiod = \"100us\"\njitter = \"5us\"\n";
    assert!(bound_beside_log("rclcpp", more, "scan") >= 123 - 100);
}

const TICK: &str = "tick = { node = \"n\", group = \"g\", period = \"20us\", wcet = \"4us\" }\n";

/// Two messages of `log` are there at 0. The first round runs one of them until 10. `tick` is due just after the first wait, and again at 20. The
/// second round runs `tick` until 14 and `log` until 24. `scan` comes just after 10, and is run by the third round, after `tick`, until 29.
#[test]
fn a_callback_waits_for_timers_in_two_rounds() {
    let scan = "scan = { node = \"n\", group = \"g\", topic = \"scan\", priority = 2, wcet = \"1us\" }\n";
    assert_eq!(bound_beside_log("rclcpp", &format!("{TICK}{scan}"), "scan"), 29 - 10);
}

/// As before, but the second round runs `tock` until 13 and `log` until 23. `tick` comes just after 10, and `tock` again at 20: it
/// may run before `tick`, which ends at 30. The bound has another `tick` in the second round.
#[test]
fn a_timer_waits_for_others_in_two_rounds() {
    let tock = "tock = { node = \"n\", group = \"g\", period = \"20us\", wcet = \"3us\" }\n";
    assert_eq!(bound_beside_log("rclcpp", &format!("{TICK}{tock}"), "tick"), 30 - 10 + 4);
}

/// `tick` is due just after 0. In rclpy, the second round goes through `m` first: it runs `log` until 20 and `tick` until 24.
#[test]
fn rclpy_runs_timers_of_one_node_after_messages_of_another() {
    assert_eq!(bound_beside_log("rclcpp", TICK, "tick"), 10 + 4 + 4);
    assert_eq!(bound_beside_log("rclpy", &TICK.replace("\"n\"", "\"m\""), "tick"), 10 + 4 + 4);
    assert_eq!(bound_beside_log("rclpy", TICK, "tick"), 24 + 4);
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
    wrong(
        topic,
        "priority = 6\n",
        "callback `g1` is a timer, which the executor of group `g` runs after its next wait",
    );
}

/// A thread of `client` nodes that has its callbacks' priorities, 30 and 10, with a timer.
fn lowered() -> String {
    "[hosts.robot]\ncores = 1\n[nodes.n]\nclient = \"rclcpp\"\n[nodes.o]\n\
     [topics.\"/a\"]\nperiod = \"10ms\"\n[topics.\"/b\"]\nperiod = \"20ms\"\n\
     [groups.g]\norder = \"priority\"\nthread_priority = \"callback\"\n\
     [callbacks.high]\nnode = \"n\"\ngroup = \"g\"\ntopic = \"/a\"\nwcet = \"1ms\"\npriority = 30\n\
     [callbacks.low]\nnode = \"n\"\ngroup = \"g\"\ntopic = \"/b\"\nwcet = \"2ms\"\npriority = 10\n\
     [callbacks.tick]\nnode = \"n\"\ngroup = \"g\"\nperiod = \"40ms\"\nwcet = \"1ms\"\n\
     [callbacks.own]\nnode = \"o\"\nperiod = \"20ms\"\nwcet = \"1ms\"\npriority = 20\n"
        .to_owned()
}

#[test]
fn a_thread_may_have_the_priorities_of_its_callbacks() {
    let file = SystemFile::parse(&lowered()).unwrap_or_else(|problems| panic!("{problems}"));
    let of = |entry: &CallbackEntry| {
        (entry.name.clone(), entry.thread_priority, entry.priority, entry.running_priority())
    };
    let found: Vec<_> = file.callbacks().iter().map(of).collect();
    let expected = [
        ("high", ThreadPriority::Callback, 30, 30),
        ("low", ThreadPriority::Callback, 30, 10),
        ("tick", ThreadPriority::Callback, 30, 30),
        ("own", ThreadPriority::Group, 20, 20),
    ];
    assert_eq!(found, expected.map(|(name, of, ceiling, own)| (name.to_owned(), of, ceiling, own)));
    let group =
        lowered().replace("thread_priority = \"callback\"", "thread_priority = \"group\"\npriority = 40");
    let file = SystemFile::parse(&group).unwrap_or_else(|problems| panic!("{problems}"));
    assert!(file.callbacks()[..3].iter().all(|entry| (entry.priority, entry.running_priority()) == (40, 40)));
}

#[test]
fn what_contradicts_the_priorities_of_callbacks_is_refused() {
    let wrong = |from: &str, to: &str, why: &str| {
        assert!(lowered().contains(from), "{from}");
        let error = SystemFile::parse(&lowered().replacen(from, to, 1)).unwrap_err().to_string();
        assert!(error.contains(why), "{error}");
        assert_eq!(error.lines().count(), 1, "{error}");
    };
    let choice = "thread_priority = \"callback\"\n";
    wrong(choice, &format!("{choice}priority = 40\n"), "leave out one of them");
    wrong(choice, "", "give it a `priority`, too, that of its thread, or `thread_priority = \"callback\"`");
    wrong("\"callback\"", "\"callbacks\"", "unknown `thread_priority` \"callbacks\"");
    wrong("order = \"priority\"\n", "", "needs `order = \"priority\"`: add that, or leave out");
    wrong(
        "priority = 10\n",
        "",
        "callback `low` of group `g` has no `priority`, by which the group's callbacks are ordered, and which",
    );
    wrong("priority = 10\n", "priority = 0\n", "is 0, out of range: set it to 1 (lowest) to 99");
    wrong("priority = 10\n", "priority = 100\n", "is 100, out of range: set it to 1 (lowest) to 99");
    // Another thread of the core may have none of its priorities by accident.
    wrong("priority = 20\n", "priority = 10\n", "`g` and `own` have priority 10 on one core");
    wrong("priority = 20\n", "priority = 30\n", "`g` and `own` have priority 30 on one core");
    let timers = "[hosts.robot]\ncores = 1\n[nodes.n]\nclient = \"rclcpp\"\n\
                  [groups.g]\norder = \"priority\"\nthread_priority = \"callback\"\n\
                  [callbacks.tick]\ngroup = \"g\"\nperiod = \"40ms\"\nwcet = \"1ms\"\n";
    let error = SystemFile::parse(timers).unwrap_err().to_string();
    assert!(error.contains("but only timers"), "{error}");
}

/// The bounds of a system with a thread that has its callbacks' priorities, in microseconds. Callbacks: name, whether of that thread, priority,
/// period, execution time; without a priority, a timer.
fn of_lowered(overheads: &str, callbacks: &[(&str, bool, Option<u8>, u64, u64)]) -> Vec<Option<u64>> {
    let mut text = format!(
        "[hosts.robot]\ncores = 1\n[overheads]\n{overheads}\n[nodes.n]\nclient = \"rclcpp\"\n[nodes.o]\n\
         [groups.g]\norder = \"priority\"\nthread_priority = \"callback\"\n"
    );
    for (name, is_member, priority, period, wcet) in callbacks {
        let (node, group) = if *is_member { ("n", "group = \"g\"\n") } else { ("o", "") };
        write!(
            text,
            "[callbacks.{name}]\nnode = \"{node}\"\n{group}wcet = \"{wcet}us\"\ndeadline = \"1s\"\n"
        )
        .unwrap();
        match priority {
            Some(priority) => write!(
                text,
                "topic = \"/{name}\"\npriority = {priority}\n[topics.\"/{name}\"]\nperiod = \"{period}us\"\n"
            ),
            None => writeln!(text, "period = \"{period}us\""),
        }
        .unwrap();
    }
    let checked = SystemFile::parse(&text).unwrap_or_else(|problems| panic!("{problems}\n{text}")).check();
    let bounds = checked.callbacks.iter().map(|callback| Some(callback.response_overhead_ns? / 1_000));
    bounds.collect()
}

/// `own` comes just after `low` has been taken, and preempts it, but not `high`: its bound is 4 instead of 24. `high` comes just after `low` has
/// been taken, too, and waits for `low` and `own`, 24 in all.
#[test]
fn others_preempt_a_low_callback_of_a_thread_that_lowers_itself() {
    let callbacks = [
        ("high", true, Some(30), 1_000, 1),
        ("low", true, Some(10), 1_000, 20),
        ("own", false, Some(20), 1_000, 3),
    ];
    assert_eq!(of_lowered("", &callbacks), [Some(24), Some(24), Some(4)]);
    // The executor takes `low` at the ceiling: 2 for each of both, in all 28 of 20 + 1 + 3 + 4.
    assert_eq!(of_lowered("rclcpp = \"2us\"", &callbacks), [Some(28), Some(28), Some(8)]);
    // A switch to each and back, and one more as `low` is lowered; of it, two are at the ceiling.
    assert_eq!(of_lowered("context_switch = \"1us\"", &callbacks)[2], Some((1 + 2) + 2 + (3 + 2)));
}

/// `high` does not wait for both `low` and `mid`: it comes just after one was taken. It waits for `own` beside `low` alone.
#[test]
fn a_rank_of_a_thread_that_lowers_itself_waits_for_one_lower_rank() {
    let callbacks = [
        ("high", true, Some(40), 1_000, 1),
        ("mid", true, Some(25), 1_000, 10),
        ("low", true, Some(10), 1_000, 20),
        ("own", false, Some(20), 1_000, 3),
    ];
    assert_eq!(of_lowered("", &callbacks), [Some(24), Some(34), Some(34), Some(14)]);
}

/// `mid` runs from 0 until 25, while three messages of `own` come, at 0, 10 and 20. Then `low` is taken, and `high` comes. `own` runs until 28 and
/// twice more, so that `low` ends at 50 and `high` at 51. What the thread kept waiting before counts: from 25 on, `own` has two releases only. The
/// bound has a sixth.
#[test]
fn others_may_have_waited_when_a_thread_lowers_itself() {
    let callbacks = [
        ("high", true, Some(40), 1_000, 1),
        ("mid", true, Some(25), 1_000, 25),
        ("low", true, Some(10), 1_000, 20),
        ("own", false, Some(20), 10, 1),
    ];
    let bounds = of_lowered("", &callbacks);
    assert!(bounds[0] >= Some(51 - 25), "{bounds:?}");
    assert_eq!(bounds[0], Some(27));
}

/// `low` ends at 15. `high` has waited since just after 0 and runs until 20, and again, for its release at 20, until 25. `own` comes at 15 and runs
/// until 28: there are two of `high` within 13, whose period is 20. The bound has a third.
#[test]
fn callbacks_that_waited_for_a_lower_one_delay_others_together() {
    let callbacks = [
        ("high", true, Some(30), 20, 5),
        ("low", true, Some(10), 1_000, 15),
        ("own", false, Some(20), 1_000, 3),
    ];
    let bounds = of_lowered("", &callbacks);
    assert!(bounds[2] >= Some(28 - 15), "{bounds:?}");
    assert_eq!(bounds[2], Some(18));
}

/// A timer runs at the ceiling, and so delays all others below it. It may be due just after `low` was taken.
#[test]
fn timers_of_a_thread_that_lowers_itself_run_at_its_ceiling() {
    let callbacks = [
        ("high", true, Some(30), 1_000, 1),
        ("low", true, Some(10), 1_000, 20),
        ("tick", true, None, 1_000, 2),
        ("own", false, Some(20), 1_000, 3),
    ];
    let bounds = of_lowered("", &callbacks);
    assert_eq!(bounds[3], Some(1 + 2 + 3));
    // At most all of the window: 1 + 20 + 2 + 3.
    assert!(bounds[..3].iter().all(|bound| *bound == Some(26)), "{bounds:?}");
}

/// The priorities of a thread that has only one are no different from those of a group.
#[test]
fn a_thread_with_one_priority_never_lowers_itself() {
    let callbacks =
        [("a", true, Some(30), 100, 4), ("b", true, Some(30), 100, 2), ("own", false, Some(20), 100, 3)];
    assert_eq!(of_lowered("context_switch = \"1us\"", &callbacks), [Some(10), Some(10), Some(15)]);
}
