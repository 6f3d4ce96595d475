// SPDX-License-Identifier: MIT OR Apache-2.0
//! Small systems for each of which a legal schedule is known: by hand, or from a simulation. Each bound is at least what happens in it, or there
//! is none. The systems are in `cases/`; times are in milliseconds.

use tautline_analysis::file::admission::{Machine, Share};
use tautline_analysis::file::{CheckedSystem, SystemFile};

macro_rules! case {
    ($name:literal) => {
        check(include_str!(concat!("cases/", $name, ".toml")))
    };
}

fn check(text: &str) -> CheckedSystem {
    SystemFile::parse(text).unwrap_or_else(|problems| panic!("{problems}\n{text}")).check()
}

/// The response of a callback, in ms.
fn response(checked: &CheckedSystem, name: &str) -> Option<f64> {
    let callback = checked.callbacks.iter().find(|callback| callback.entry.name == name);
    callback.unwrap_or_else(|| panic!("no callback {name}")).response_overhead_ns.map(ms)
}

fn ms(ns: u64) -> f64 {
    ns as f64 / 1e6
}

/// A bound is no less than what happens; none is one, too, if a warning says why and the check fails.
#[track_caller]
fn covers(checked: &CheckedSystem, bound: Option<f64>, truth: f64) {
    match bound {
        Some(bound) => assert!(bound >= truth, "the bound is {bound}, the truth is {truth}"),
        None => assert!(!checked.schedulable && !checked.warnings.is_empty(), "{:#?}", checked.warnings),
    }
}

/// As [`covers`], for the response of a callback, in ms.
#[track_caller]
fn covers_response(checked: &CheckedSystem, name: &str, truth: f64) {
    covers(checked, response(checked, name), truth);
}

#[track_caller]
fn warns(checked: &CheckedSystem, of: &str) {
    assert!(checked.warnings.iter().any(|warning| warning.contains(of)), "{of}: {:#?}", checked.warnings);
}

/// The first runs at 0, the second overwrites its value at 2, the reader never sees it.
#[test]
fn a_register_that_others_write_reflects_nobody_for_sure() {
    let checked = case!("register_two_writers");
    let chain = &checked.chains[0];
    assert_eq!((chain.latency_ns, chain.reaction_ns, chain.met), (None, None, false));
    assert!(!checked.schedulable);
    warns(&checked, "`p2`");
}

#[test]
fn a_publisher_with_two_triggers_overwrites_its_own_register() {
    let checked = check(
        "[hosts.h]\ncores = 1\n[nodes.n]\n[topics]\na = { period = \"10ms\" }\nb = { period = \"10ms\" }\n\
         [callbacks.p]\ntopic = [\"a\", \"b\"]\nwcet = \"1ms\"\npublishes = \"o\"\n\
         [callbacks.q]\nperiod = \"10ms\"\nwcet = \"1ms\"\nreads = \"o\"\n\
         [[chains]]\nname = \"c\"\npath = [\"p\", \"q\"]\ndeadline = \"50ms\"\n",
    );
    assert_eq!((checked.chains[0].reaction_ns, checked.schedulable), (None, false));
}

/// While `long` runs, the newest tick of `x` moves behind what came before that tick.
#[test]
fn a_timer_in_a_group_waits_behind_what_came_before_its_newest_tick() {
    let checked = case!("timer_in_group");
    covers(&checked, checked.chains[0].reaction_ns.map(ms), 15.04);
    covers(&checked, checked.chains[1].age_ns.map(ms), 14.99);
    covers(&checked, checked.chains[1].latency_ns.map(ms), 15.99);
}

/// In file A, the lower one holds the lock of the higher one; who is between them, in file B, waits for it.
#[test]
fn locks_of_one_file_block_what_another_file_has() {
    let head = "[hosts.h]\ncores = 1\n[nodes.n]\n";
    let a = format!(
        "{head}[callbacks.a1]\nperiod = \"100ms\"\nwcet = \"2ms\"\npriority = 50\n\
         locks = [{{ resource = \"map\", length = \"1ms\" }}]\n\
         [callbacks.a2]\nperiod = \"100ms\"\nwcet = \"9ms\"\npriority = 10\n\
         locks = [{{ resource = \"map\", length = \"8ms\" }}]\n"
    );
    let b = format!(
        "{head}[callbacks.b]\nperiod = \"100ms\"\nwcet = \"3ms\"\ndeadline = \"6ms\"\npriority = 30\n"
    );
    let (a, b) = (SystemFile::parse(&a).unwrap(), SystemFile::parse(&b).unwrap());
    let mut machine = Machine::default();
    machine.add_file(Share { file: &a, host: "h", label: "a.toml" });
    machine.add_file(Share { file: &b, host: "h", label: "b.toml" });
    let checked = machine.check();
    covers_response(&checked, "b", 13.0);
}

/// A job that was demoted ends just before the next one.
#[test]
fn a_demoted_publisher_publishes_late() {
    covers_response(&case!("demoted_publisher"), "low", 12.0);
}

/// It is demoted while it holds the lock that the lower one needs next.
#[test]
fn a_demoted_job_that_holds_a_lock_blocks_as_a_lower_one() {
    covers_response(&case!("demoted_with_lock"), "mid", 7.0);
}

/// At 0 a demoted job is at the begin of its section, with which it ends at 4. The next one is released then, uses its budget up just after it
/// takes the lock again, and ends with that section at 13.
#[test]
fn every_demoted_job_may_end_with_a_section() {
    covers_response(&case!("demoted_at_the_end_of_a_section"), "mid", 23.0);
}

/// What piled up during the stall uses up the runtime, so that the kernel stops it again.
#[test]
fn what_catches_up_after_a_stall_may_be_throttled() {
    let checked = case!("stall_and_throttling");
    let low = checked.callbacks.iter().find(|callback| callback.entry.name == "low").unwrap();
    covers(&checked, low.capacity.map(|capacity| capacity as f64), 65.0);
}

#[test]
fn the_gateway_works_for_what_is_only_read() {
    covers_response(&case!("gateway_of_a_register"), "ctl", 8.0);
    covers_response(&case!("gateway_of_a_trigger"), "ctl", 0.8);
}

/// What was left of one budget is used right before the next.
#[test]
fn a_suspended_job_may_use_two_budgets_at_once() {
    covers_response(&case!("suspended_with_jitter"), "low", 11.0);
}

#[test]
fn an_executor_of_ros_polls_in_rounds() {
    let checked = case!("rclcpp_group");
    let longest = checked.callbacks.iter().filter_map(|callback| callback.response_overhead_ns).max();
    covers(&checked, longest.map(ms), 84.0);
    assert!(!checked.schedulable);
}

/// The budget has room for all work per message, and the sampler does its part besides.
#[test]
fn a_demoted_job_uses_the_samplers_part_of_its_budget_too() {
    covers_response(&case!("demoted_budget"), "low", 5.53);
}

/// A job takes 4.07 ms, the reservation has 4.03.
#[test]
fn a_reservation_pays_for_its_messages() {
    let checked = case!("reservation_and_messages");
    covers_response(&checked, "points", 20.0);
    warns(&checked, "reservation");
}

/// One section lasts to 9. The runtime is used up at 15; the other section begins just before the next period, at 19, and lasts to 28.
#[test]
fn a_section_may_begin_while_a_reservation_waits() {
    covers_response(&case!("section_in_a_gap"), "points", 29.99);
}

#[test]
fn a_floating_reservation_may_wake_in_a_section_of_any_core() {
    covers_response(&case!("floating_reservation"), "fast", 8.99);
}

#[test]
fn a_join_in_a_group_takes_all_that_is_queued() {
    covers_response(&case!("join_in_group"), "m", 41.0);
}

/// The sensor's messages come at 1, 11, 21 ..., the slow one's at 0, 100, 200 ... a moment before: the set at 100 has the sensor's release of 90,
/// and its value is there until the set at 200. The reader's job from 200 to 201 uses it: it is 111 old, though the sensor sent ten more.
#[test]
fn a_value_of_a_join_ages_until_the_next_set() {
    let file = |more: &str| {
        format!(
            "[hosts.h]\ncores = 4\n[nodes.n]\n[topics]\nslow = {{ period = \"100ms\" }}\n\
             [callbacks.sensor]\ncore = 0\nperiod = \"10ms\"\nwcet = \"1ms\"\npublishes = \"fast\"\n\
             [callbacks.fuse]\ncore = 1\nall = [\"fast\", \"slow\"]\n{more}take = \"1us\"\nwcet = \"1us\"\npublishes = \"fused\"\n\
             [callbacks.reader]\ncore = 2\nperiod = \"10ms\"\nwcet = \"1ms\"\nreads = \"fused\"\n\
             [[chains]]\nname = \"c\"\npath = [\"sensor\", \"fuse\", \"reader\"]\ndeadline = \"1s\"\n"
        )
    };
    for more in ["", "window = \"12ms\"\n"] {
        let checked = check(&file(more));
        covers(&checked, checked.chains[0].age_ns.map(ms), 111.0);
    }
}

#[test]
fn no_way_of_a_chain_is_left_out() {
    let checked = case!("many_ways");
    covers(&checked, checked.chains[0].latency_ns.map(ms), 61_000.0);
}

#[test]
fn who_waits_for_a_lock_pays_for_two_switches_more() {
    covers_response(&case!("inheritance_switches"), "high", 8.0);
}

/// The lower one runs from 1 on and takes the lock. The higher one comes at once, runs from 2 on and waits; the lower one has its section from 3 to 6, the
/// higher one runs from 7 to 9, and the lower one has its last 2 ms from 10 to 12.
#[test]
fn who_holds_a_lock_pays_for_the_switches_of_who_waits() {
    covers_response(&case!("inheritance_switches"), "low", 12.0);
}

/// `low` runs from 1 on. `held` comes at 1 and at 11: 1 ms to switch to it, 2 ms until its budget is used up, 1 ms to switch back.
#[test]
fn a_budget_ends_with_a_switch_to_another() {
    let text = "[hosts.h]\ncores = 1\n[overheads]\ncontext_switch = \"1ms\"\n[nodes.n]\n\
                [callbacks.held]\nperiod = \"10ms\"\nwcet = \"1ms\"\npriority = 50\noverrun = \"suspend\"\n\
                [callbacks.low]\nperiod = \"100ms\"\nwcet = \"10ms\"\npriority = 30\n";
    covers_response(&check(text), "low", 19.0);
    covers_response(&check(&text.replace("suspend", "demote")), "low", 19.0);
}

#[test]
fn interrupts_and_throttling_do_not_wait_for_a_section() {
    covers_response(&case!("tail_and_ticks"), "a", 11.2);
    covers_response(&case!("tail_and_throttling"), "a", 12.0);
}

#[test]
fn a_late_timer_of_a_group_keeps_its_place() {
    covers_response(&case!("late_timer_in_group"), "m", 29.0);
}

#[test]
fn a_join_that_may_starve_has_no_reaction_time() {
    let checked = case!("starving_join");
    assert_eq!(checked.chains[0].reaction_ns, None);
    warns(&checked, "nothing bounds how long a message waits");
}

/// Nothing bounds how many messages of `o` come at once, and the work for each is above everything.
#[test]
fn what_triggers_without_a_bound_delays_all_by_its_messages() {
    let checked = case!("unbounded_publisher");
    assert_eq!(
        (response(&checked, "high"), response(&checked, "sub"), checked.schedulable),
        (None, None, false)
    );
}

#[test]
fn a_message_that_others_overtake_waits_for_them() {
    let checked = case!("reordering_network");
    covers(&checked, checked.chains[0].latency_ns.map(ms), 40.9);
}

/// The job of 0 sends at 57 us and the next one at 63, yet its value comes last, at 73. It stays until that of the third comes at 193; a reader that
/// starts just before ends at 224.
#[test]
fn a_value_that_overtakes_the_next_is_a_period_older() {
    let checked = case!("reordering_network_and_early_jobs");
    covers(&checked, checked.chains[0].age_ns.map(ms), 0.2239);
}

/// The message of 0 is sent at 24 and comes at 84, that of 60 is sent at 61 and comes at 63: the value that is made of the first is written last, at 91,
/// and stays until that of the third, sent at 144, is written at 211. A reader that starts just before ends at 224.
#[test]
fn a_value_made_of_an_overtaken_message_is_a_period_older() {
    let checked = case!("reordering_network_before_a_register");
    covers(&checked, checked.chains[0].age_ns.map(ms), 0.2239);
}

#[test]
fn any_trigger_of_a_reader_reflects_what_it_reads() {
    let checked = case!("reader_with_two_triggers");
    assert_eq!(checked.chains[0].reaction_ns.map(ms), Some(24.0));
}

#[test]
fn the_gateway_works_once_for_a_message() {
    let checked = case!("gateway_of_three");
    assert_eq!(response(&checked, "s1"), Some(1.5));
}

#[test]
fn a_callback_above_the_sampler_is_a_fault() {
    let checked = case!("above_the_sampler");
    assert!(!checked.schedulable);
    warns(&checked, "not below the sampler's 90");
}

#[test]
fn a_node_on_two_cores_is_a_fault() {
    let checked = check(
        "[hosts.h]\ncores = 2\n[nodes.n]\n[callbacks]\n\
         a = { period = \"10ms\", wcet = \"1ms\", core = 0 }\nb = { period = \"10ms\", wcet = \"1ms\", core = 1 }\n",
    );
    assert!(!checked.schedulable);
    warns(&checked, "split the node");
}

#[test]
fn cores_that_do_not_exist_are_problems() {
    let text = include_str!("cases/no_cores.toml");
    for cores in ["0", "[]", "-1", "[0, -1]", "[0, 0]", "5000"] {
        let problems =
            SystemFile::parse(&text.replace("cores = 0", &format!("cores = {cores}"))).unwrap_err();
        assert!(problems.to_string().contains("`cores` of host `h`"), "{cores}: {problems}");
    }
}

#[test]
fn a_wait_without_a_bound_is_none() {
    let checked = check(
        "[hosts.h]\ncores = 1\n[nodes.n]\n[topics]\na = { period = \"18446744073709551613ns\" }\n\
         b = { period = \"18446744073709551613ns\", jitter = \"100s\" }\n\
         [callbacks.fuse]\nall = [\"a\", \"b\"]\nwcet = \"1ms\"\n",
    );
    let waits = checked.callbacks[0].join.iter().flat_map(|join| &join.inputs);
    assert!(waits.clone().all(|(_, wait)| *wait != Some(u64::MAX)));
    assert!(!checked.schedulable && !checked.warnings.is_empty());
}

#[test]
fn a_jitter_without_sense_is_named() {
    let text = "[hosts.h]\ncores = 1\n[nodes.n]\n[callbacks.a]\nperiod = \"4ms\"\nwcet = \"1ms\"\njitter = \"1000000000s\"\n";
    let checked = check(text);
    assert!(!checked.schedulable);
    warns(&checked, "jitter");
    assert!(
        checked.warnings.iter().all(|warning| !warning.contains("too close to 100 %")),
        "{:?}",
        checked.warnings
    );
}

#[test]
fn what_a_terminal_would_obey_is_refused_and_escaped() {
    let text = |name: &str| {
        format!("[hosts.h]\ncores = 1\n[nodes.n]\n[callbacks.{name}]\nperiod = \"4ms\"\nwcet = \"1ms\"\n")
    };
    for name in ["\"a\\u001b[31m\"", "\"a\\u0007\"", "\"a\\nb\"", "\"\\u202e\"", "\"\""] {
        let problems = SystemFile::parse(&text(name)).unwrap_err().to_string();
        assert!(problems.contains("use printable characters"), "{problems}");
        assert!(problems.chars().all(|c| !c.is_control() && c != '\u{202e}'), "{problems:?}");
    }
    let others = [
        "[hosts.\"\\u001b\"]",
        "[nodes.\"\\u001b\"]",
        "[topics.\"\\u001b\"]",
        "[groups.\"\\u001b\"]",
        "\"\\u001b\" = 1",
    ];
    for other in others {
        let problems = SystemFile::parse(&format!("{}\n{other}\n", text("a"))).unwrap_err().to_string();
        assert!(!problems.contains('\u{1b}') && problems.contains("\\u{1b}"), "{problems:?}");
    }
    assert!(SystemFile::parse(&text("\"/größe/имя\"")).is_ok());
}

#[test]
fn a_mistake_in_the_toml_says_how_to_mend_it() {
    let problems = SystemFile::parse("[hosts.h]\ncores = \n").unwrap_err();
    assert!(problems.to_string().starts_with("2:"), "{problems}");
    assert!(problems.to_string().contains(": write"), "{problems}");
}

/// A job that is not preempted gives up the core where it waits for a lock.
#[test]
fn a_job_that_waits_for_a_lock_is_preempted_meanwhile() {
    covers_response(&case!("section_waits_for_a_lock"), "mid", 16.0);
}

#[test]
fn the_most_load_is_no_panic() {
    let most = "[hosts.h]\ncores = 1\n[overheads]\nper_message = \"18446744073709551615ns\"\n[nodes.n]\n[callbacks.a]\n\
                period = \"1ns\"\nwcet = \"1ns\"\n";
    let checked = check(most);
    assert!(!checked.schedulable && !checked.warnings.is_empty());
}
