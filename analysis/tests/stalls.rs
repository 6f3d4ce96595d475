// SPDX-License-Identifier: MIT OR Apache-2.0
//! Queues that outlast a stall: hand-computed cases, and what is wrong with a file. runtime.rs has random systems.

use std::fmt::Write;

use tautline_analysis::file::admission::{Machine, Share};
use tautline_analysis::file::{CheckedSystem, SystemFile};

fn check(text: &str) -> CheckedSystem {
    SystemFile::parse(text).unwrap_or_else(|problems| panic!("{problems}\n{text}")).check()
}

/// Of each callback, with and without stalls.
fn capacities(text: &str) -> Vec<(usize, usize)> {
    let checked = check(text);
    let of = |with: Option<usize>, without: Option<usize>| (with.unwrap(), without.unwrap());
    checked.callbacks.iter().map(|c| of(c.capacity, c.capacity_without_stall)).collect()
}

const LIDAR: &str = "[hosts.robot]\ncores = 1\nstall = \"50ms\"\n[nodes.n]\n[topics]\n\"/scan\" = { period = \"20ms\" }\n\
                     [callbacks.scan]\ntopic = \"/scan\"\nwcet = \"12ms\"\n";

#[test]
fn a_queue_holds_what_comes_while_its_core_stands_still() {
    // 50 + 12 ms after the first message the fourth has come.
    assert_eq!(capacities(LIDAR), [(4, 1)]);
    assert_eq!(capacities(&LIDAR.replace("stall = \"50ms\"\n", "")), [(1, 1)]);
    assert_eq!(capacities(&LIDAR.replace("50ms", "0ms")), [(1, 1)]);
    // Neither bounds nor verdicts contain it.
    let scan = check(LIDAR);
    assert_eq!((scan.schedulable, scan.callbacks[0].response_overhead_ns), (true, Some(12_000_000)));
    assert_eq!((scan.cores[0].stall_ns, scan.cores[0].overheads), (50_000_000, Default::default()));
    // A depth that the file states is held against it.
    let stated = check(&LIDAR.replace("{ period", "{ depth = 2, period"));
    assert!(
        stated.warnings.iter().any(|warning| warning.contains("needs a queue of 4, but its topic keeps 2"))
    );
}

#[test]
fn what_piled_up_above_goes_first() {
    let timer = "[callbacks.timer]\nperiod = \"10ms\"\nwcet = \"5ms\"\npriority = 9\n";
    let low = "[callbacks.scan]\npriority = 1\n";
    let text =
        LIDAR.replace("20ms", "10ms").replace("12ms", "1ms").replace("[callbacks.scan]\n", low) + timer;
    // Not 50 + 6 ms: 50 + 1 ms and eleven runs of the timer, which has half of the core, take 106.
    assert_eq!(capacities(&text)[0], (11, 1));
}

#[test]
fn messages_bunch_while_the_publisher_stands_still() {
    let text = |hosts: &str, nodes: [&str; 2]| {
        let [driver, control] = nodes;
        format!(
            "{hosts}[network]\nlatency = [\"1ms\", \"1ms\"]\n[nodes.driver]\n{driver}\n[nodes.control]\n{control}\n\
             [topics]\n\"/scan\" = {{ remote = true }}\n\
             [callbacks.scan]\nnode = \"driver\"\nperiod = \"20ms\"\nwcet = \"1ms\"\npublishes = \"/scan\"\n\
             [callbacks.plan]\nnode = \"control\"\ntopic = \"/scan\"\nwcet = \"1ms\"\n"
        )
    };
    let robot = "[hosts.robot]\ncores = 2\nstall = \"50ms\"\n";
    // A message comes up to 51 ms late, and waits up to 51 ms: one core may stand still after the other.
    let two_cores = text(robot, ["core = 0", "core = 1"]);
    assert_eq!(capacities(&two_cores), [(3, 1), (6, 1)]);
    // A core that stands still after it has caught up delays both again; the publisher's backlog goes first.
    let one_core = text(robot, ["core = 0", "core = 0"]);
    assert_eq!(capacities(&one_core), [(3, 1), (6, 1)]);
    // Between hosts, the gateways may stand still besides: 51 + 50 + 20 late, 21 waiting.
    let hosts = "[hosts.robot]\ncores = 1\nstall = \"50ms\"\n[hosts.pc]\ncores = 1\nstall = \"20ms\"\n";
    let two_hosts = text(hosts, ["host = \"robot\"", "host = \"pc\""]);
    assert_eq!(capacities(&two_hosts), [(3, 1), (8, 1)]);
    // Only what a stall reaches is deeper.
    let steady = text(&hosts.replace("stall = \"50ms\"\n", ""), ["host = \"robot\"", "host = \"pc\""]);
    assert_eq!(capacities(&steady), [(1, 1), (3, 1)]);
}

#[test]
fn what_comes_from_a_host_outside_passes_this_ones_gateway() {
    // It may come 50 ms late, at once with two others, and wait for 50 ms and theirs: 86 after 50.
    let text = LIDAR.replace("{ period", "{ remote = true, period");
    assert_eq!(capacities(&text), [(7, 1)]);
    // However far apart they were sent.
    let apart = text.replace("period = \"20ms\"", "period = \"20ms\", min_distance = \"20ms\"");
    assert_eq!(capacities(&apart), [(7, 1)]);
}

#[test]
fn a_sampler_on_another_core_may_stand_still_first() {
    let [period, cores] = [("20ms", "1ms"), ("cores = 1", "cores = 2")];
    let text = LIDAR.replace(period.0, period.1).replace(cores.0, cores.1).replace("12ms", "0.1ms");
    let other = "[callbacks.timer]\nperiod = \"10ms\"\nwcet = \"0.1ms\"\n";
    let on = |core: usize| format!("{text}core = 0\n{other}core = {core}\n");
    // Beside it, the timer may run before it; on another core, its sampler may stand still before it does.
    assert!((51..=57).contains(&capacities(&on(0))[0].0), "{:?}", capacities(&on(0)));
    assert!((101..=112).contains(&capacities(&on(1))[0].0), "{:?}", capacities(&on(1)));
}

#[test]
fn a_thread_of_several_callbacks_and_a_join_have_deeper_queues() {
    let group = "[hosts.robot]\ncores = 1\nSTALL[nodes.n]\n[groups.g]\n[topics]\n\"/a\" = { period = \"10ms\" }\n\"/b\" = { period = \"30ms\" }\n\
                 [callbacks.a]\ntopic = \"/a\"\nwcet = \"1ms\"\ngroup = \"g\"\n\
                 [callbacks.b]\ntopic = \"/b\"\nwcet = \"2ms\"\ngroup = \"g\"\n";
    // 50 ms and one job of each.
    assert_eq!(capacities(&group.replace("STALL", "stall = \"50ms\"\n")), [(6, 1), (2, 1)]);
    let join = "[hosts.robot]\ncores = 1\nSTALL[nodes.n]\n[topics]\n\"/a\" = { period = \"10ms\" }\n\"/b\" = { period = \"30ms\" }\n\
                [callbacks.fuse]\nall = [\"/a\", \"/b\"]\nwindow = \"30ms\"\nwcet = \"2ms\"\n";
    let (still, steady) =
        (check(&join.replace("STALL", "stall = \"50ms\"\n")), check(&join.replace("STALL", "")));
    let (still, steady) = (&still.callbacks[0], &steady.callbacks[0]);
    assert_eq!(still.capacity_without_stall, steady.capacity);
    assert!(still.capacity >= Some(6) && steady.capacity == Some(1), "{still:?}");
    let (still, steady) = (still.join.as_ref().unwrap(), steady.join.as_ref().unwrap());
    assert_eq!(still.inputs, steady.inputs);
    assert!(still.queue_size >= steady.queue_size + 5, "{still:?}, {steady:?}");
}

#[test]
fn a_stall_of_many_periods_is_bounded() {
    let mut text = LIDAR.replace("20ms", "1ms").replace("12ms", "10us") + "publishes = \"/0\"\n";
    for stage in 1..=4 {
        let next = stage - 1;
        writeln!(
            text,
            "[callbacks.c{stage}]\ntopic = \"/{next}\"\nwcet = \"10us\"\npublishes = \"/{stage}\""
        )
        .unwrap();
    }
    let found = capacities(&text);
    assert!(found.iter().all(|(with, without)| (51..400).contains(with) && *without == 1), "{found:?}");
}

#[test]
fn files_of_one_machine_have_its_longest_stall() {
    let (short, long) = (LIDAR.replace("50ms", "30ms"), LIDAR.replace("robot", "pc").replace("scan", "map"));
    let files = [short, long].map(|text| SystemFile::parse(&text).unwrap());
    let mut machine = Machine::default();
    for (file, host) in files.iter().zip(["robot", "pc"]) {
        machine.add_file(Share { file, host, label: host });
    }
    let checked = machine.check();
    assert_eq!(checked.cores.iter().map(|core| core.stall_ns).collect::<Vec<_>>(), [50_000_000]);
    assert_eq!(checked.callbacks.len(), 2);
}

#[test]
fn what_is_wrong_with_a_stall_is_said_with_its_line() {
    for (wrong, what) in [
        ("\"-5ms\"", "`stall` is not a time: \"-5ms\"; write one such as \"1.5ms\""),
        ("\"50\"", "`stall` is not a time: \"50\""),
        ("50", "`stall` must be a time with its unit, such as \"1.5ms\", not a number"),
        ("\"99999999999999999999s\"", "`stall` is \"99999999999999999999s\", longer than 18446744073 s"),
        ("\"50s\"", "`stall` of host `robot` is 50 s, out of range: set it to 10s at most"),
    ] {
        let problems = SystemFile::parse(&LIDAR.replace("\"50ms\"", wrong)).unwrap_err().to_string();
        assert!(problems.starts_with("3:9: ") && problems.contains(what), "{problems}");
    }
    assert!(SystemFile::parse(&LIDAR.replace("50ms", "10s")).is_ok());
}
