// SPDX-License-Identifier: MIT OR Apache-2.0
//! System files: the examples, everything that can be wrong with one, and one of a thousand callbacks.
use std::fmt::Write;
use std::time::Instant;

use rand::RngExt;
use tautline_analysis::Reservation;
use tautline_analysis::file::{
    CheckedCallback, CheckedSystem, Executor, JoinPolicy, LinkPriority, OverrunPolicy, SystemFile, WakeUp,
};

/// A system without problems, to which the tests add some.
const GOOD: &str = r#"
[hosts.robot]
cores = 2
[nodes.driver]
core = 0
[nodes.control]
core = 1
[topics]
"/joy" = { period = "20ms" }
[callbacks.scan]
node = "driver"
period = "10ms"
wcet = "2ms"
publishes = "/scan"
[callbacks.plan]
node = "control"
topic = "/scan"
wcet = "3ms"
publishes = ["/path", "/debug"]
[callbacks.drive]
node = "control"
topic = ["/path", "/joy"]
wcet = "1ms"
[[chains]]
name = "scan to drive"
path = ["scan", "plan", "drive"]
deadline = "20ms"
"#;

fn example(name: &str) -> CheckedSystem {
    let path = format!("{}/../examples/systems/{name}.toml", env!("CARGO_MANIFEST_DIR"));
    SystemFile::read(path).unwrap_or_else(|error| panic!("{error}")).check()
}

/// All problems of a text, one line each.
fn problems(text: &str) -> Vec<String> {
    match SystemFile::parse(text) {
        Ok(_) => Vec::new(),
        Err(problems) => problems.to_string().lines().map(str::to_owned).collect(),
    }
}

/// The good file with one piece replaced.
fn with(piece: &str, replacement: &str) -> String {
    assert!(GOOD.contains(piece), "{piece}");
    GOOD.replacen(piece, replacement, 1)
}

/// Asserts that a file has exactly these problems, each given by its line and a part of its text.
fn expect(text: &str, expected: &[(usize, &str)]) {
    let found = problems(text);
    let matches = found.len() == expected.len()
        && found
            .iter()
            .zip(expected)
            .all(|(f, (line, part))| f.starts_with(&format!("{line}:")) && f.contains(part));
    assert!(matches, "expected {expected:#?}, found {found:#?}");
}

/// Who wakes each callback's thread.
fn wake_ups(text: &str) -> Vec<WakeUp> {
    let file = SystemFile::parse(text).unwrap_or_else(|problems| panic!("{problems}"));
    file.callbacks().iter().map(|callback| callback.wake_up).collect()
}

#[test]
fn publishers_wake_what_only_topics_trigger() {
    let timer = WakeUp::Sampler("its thread has a timer");
    assert_eq!(wake_ups(GOOD), [timer, WakeUp::Publisher, WakeUp::Publisher]);
    // Whatever is stated counts; of a group for all.
    let said = WakeUp::Sampler("the file says so");
    let stated = with("wcet = \"2ms\"", "wcet = \"2ms\"\ndirect_wake = true");
    let stated = stated.replacen("wcet = \"3ms\"", "wcet = \"3ms\"\ndirect_wake = false", 1);
    assert_eq!(wake_ups(&stated), [WakeUp::Publisher, said, WakeUp::Publisher]);
    let grouped = |group: &str| {
        let text = GOOD.replace("node = \"control\"\n", "node = \"control\"\ngroup = \"both\"\n");
        wake_ups(&format!("{text}[groups.both]\n{group}"))
    };
    assert_eq!(grouped(""), [timer, WakeUp::Publisher, WakeUp::Publisher]);
    assert_eq!(grouped("direct_wake = false"), [timer, said, said]);
    // A timer of the thread is one of all its callbacks.
    let text = GOOD.replace("topic = [\"/path\", \"/joy\"]", "period = \"20ms\"");
    let text = text.replace("node = \"control\"\n", "node = \"control\"\ngroup = \"both\"\n");
    let text = text.replace("\"scan\", \"plan\", \"drive\"", "\"scan\", \"plan\"");
    assert_eq!(wake_ups(&format!("{text}[groups.both]")), [timer, timer, timer]);
    let ros = with("[nodes.control]", "[nodes.control]\nclient = \"rclcpp\"");
    assert_eq!(wake_ups(&ros)[1], WakeUp::Publisher);
    let ros = ros.replacen("wcet = \"3ms\"", "wcet = \"3ms\"\ndirect_wake = false", 1);
    expect(&ros, &[(20, "callback `plan` is run by an executor of ROS 2's, which publishers wake")]);
}

/// A publisher would wake one after the other, and be preempted by the first.
#[test]
fn the_sampler_wakes_threads_that_take_one_topic() {
    let text = with("topic = [\"/path\", \"/joy\"]", "topic = \"/path\"");
    let text = text + "[callbacks.log]\nnode = \"driver\"\ntopic = \"/scan\"\nwcet = \"1ms\"\n";
    let found = wake_ups(&text);
    let shared = WakeUp::Sampler("another thread takes one of its topics");
    assert_eq!(found[1..], [shared, WakeUp::Publisher, shared]);
}

#[test]
fn publishers_wake_threads_of_as_many_topics_as_a_bell_has_places() {
    for (topics, is_direct) in [(63, true), (64, false)] {
        let mut text = String::from("[hosts.robot]\ncores = 1\n[nodes.control]\n[topics]\n");
        (0..topics).for_each(|i| writeln!(text, "t{i} = {{ period = \"10s\" }}").unwrap());
        let names: Vec<_> = (0..topics).map(|i| format!("\"t{i}\"")).collect();
        writeln!(text, "[callbacks.c]\ntopic = [{}]\nwcet = \"1us\"\npriority = 10", names.join(", "))
            .unwrap();
        assert_eq!(wake_ups(&text)[0] == WakeUp::Publisher, is_direct);
    }
}

#[test]
fn a_wake_up_is_stated_of_a_thread() {
    let grouped = with("wcet = \"3ms\"", "wcet = \"3ms\"\ngroup = \"both\"\ndirect_wake = true");
    let expected = "callback `plan` shares its thread: say `direct_wake` in [groups]";
    expect(&format!("{grouped}[groups.both]"), &[(20, expected)]);
    expect(
        &with("wcet = \"3ms\"", "wcet = \"3ms\"\ndirect_wake = 1"),
        &[(19, "`direct_wake` must be true or false")],
    );
}

#[test]
fn the_published_set() {
    let checked = example("paper");
    let times = |time: fn(&tautline_analysis::file::CheckedCallback) -> Option<u64>| {
        checked.callbacks.iter().map(|c| time(c).unwrap() / 1_000).collect::<Vec<_>>()
    };
    assert_eq!(times(|c| c.response_ns), [2_000, 6_000, 13_000, 36_000, 170_000]);
    assert_eq!(times(|c| c.response_overhead_ns), [2_300, 6_300, 13_360, 36_540, 174_040]);
    assert!(checked.schedulable && checked.warnings.is_empty());
    assert!(checked.callbacks.iter().all(|c| c.capacity == Some(1)));

    let thread = example("one-thread");
    assert!(!thread.schedulable);
    assert!(thread.callbacks.iter().all(|c| c.response_ns == Some(76_000_000)));
    let capacities: Vec<_> = thread.callbacks.iter().map(|c| c.capacity.unwrap()).collect();
    assert_eq!(capacities, [8, 4, 2, 1, 1]);
}

#[test]
fn the_other_examples_are_schedulable() {
    for name in ["two-hosts", "groups"] {
        let checked = example(name);
        assert!(checked.schedulable, "{name}: {checked:#?}");
        assert!(!checked.chains.is_empty());
    }
    let reserved = example("reserved");
    assert!(reserved.schedulable && reserved.warnings.is_empty(), "{reserved:#?}");
    for name in ["../rclcpp/five", "../rclcpp/one", "../rclcpp/reference"] {
        let rclcpp = example(name);
        assert!(rclcpp.schedulable, "{name}: {rclcpp:#?}");
    }
    // From the lidar's 4 ms on one host over the network, planning on the other, and back.
    let chain = &example("two-hosts").chains[0];
    assert!((20_000_000..24_000_000).contains(&chain.latency_ns.unwrap()), "{chain:?}");
    // Over the network, and through a join, there is more on the way than the responses of callbacks.
    assert_eq!((&chain.stages, &example("fusion").chains[0].stages), (&None, &None));
    let lanes = example("alks/system");
    let names = lanes.chains[0].stages.iter().flatten().map(|at| lanes.callbacks[*at].entry.name.as_str());
    assert_eq!(names.collect::<Vec<_>>(), ["imu", "on_odometry", "show_odometry"]);
}

#[test]
fn a_good_file_and_what_it_says() {
    let file = SystemFile::parse(GOOD).unwrap();
    let priorities: Vec<_> = file.callbacks().iter().map(|c| (c.name.as_str(), c.priority, c.core)).collect();
    assert_eq!(priorities, [("scan", 80, 0), ("plan", 80, 1), ("drive", 79, 1)]);
    assert_eq!(
        file.topics().iter().map(|t| t.name.as_str()).collect::<Vec<_>>(),
        ["/joy", "/scan", "/path", "/debug"]
    );
    let checked = file.check();
    assert!(checked.schedulable, "{checked:#?}");
    // `drive` is reached in two ways, by /path and by /joy; its queue holds what both may bring.
    assert_eq!(checked.callbacks[2].entry.tasks.len(), 2);
    assert_eq!(checked.callbacks[2].capacity, Some(2));
    // 2 + (3 + 1 + 1): `plan`, and the other message before its own.
    assert_eq!(checked.chains[0].latency_ns, Some(7_000_000));
    assert_eq!(checked.chains[0].stages, Some(vec![0, 1, 2]));
    assert!(checked.warnings[0].contains("no [overheads]"), "{:?}", checked.warnings);
}

#[test]
fn the_schema_knows_what_the_reader_knows() {
    let path = format!("{}/../docs/system.schema.json", env!("CARGO_MANIFEST_DIR"));
    let schema: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    for (pointer, section) in [
        ("", ""),
        ("/properties/priorities", "[priorities]"),
        ("/properties/network", "[network]"),
        ("/definitions/overheads", "[overheads]"),
        ("/definitions/overheads/properties/tick", "[overheads.tick]"),
        ("/definitions/overheads/properties/throttling", "[overheads.throttling]"),
        ("/definitions/host", "[hosts.x]"),
        ("/definitions/node", "[nodes.x]"),
        ("/definitions/topic", "[topics.x]"),
        ("/definitions/group", "[groups.x]"),
        ("/definitions/callback", "[callbacks.x]"),
        ("/definitions/callback/properties/locks/items", "[[callbacks.x.locks]]"),
        ("/definitions/callback/properties/reservation", "[callbacks.x.reservation]"),
        ("/definitions/chain", "[[chains]]"),
    ] {
        // The message about a key that nobody knows lists those that are known.
        let found = problems(&format!("{section}\nunheard-of-in-any-section = 1\n"));
        let known =
            found.iter().find_map(|p| p.split_once("(known: ")?.1.strip_suffix(')')).unwrap_or_default();
        let mut known: Vec<_> = known.split(", ").collect();
        let described =
            schema.pointer(&format!("{pointer}/properties")).and_then(|keys| keys.as_object()).unwrap();
        let mut described: Vec<_> = described.keys().map(String::as_str).collect();
        known.sort_unstable();
        described.sort_unstable();
        known.dedup();
        assert_eq!(known, described, "{section}");
    }
    let overruns = schema.pointer("/definitions/callback/properties/overrun/enum").unwrap();
    assert_eq!(*overruns, serde_json::json!(OverrunPolicy::ALL.map(OverrunPolicy::as_str)));
    let executors = schema.pointer("/definitions/node/properties/executor/enum").unwrap();
    assert_eq!(*executors, serde_json::json!(Executor::ALL.map(Executor::as_str)));
    let policies = schema.pointer("/definitions/callback/properties/policy/enum").unwrap();
    assert_eq!(*policies, serde_json::json!(JoinPolicy::NAMED.map(JoinPolicy::as_str)));
}

#[test]
fn a_topics_place_on_a_busy_link() {
    let text = format!(
        "{GOOD}\n[topics.\"/cmd_vel\"]\npriority = \"real_time\"\nexpress = true\n[topics.\"/map\"]\npriority = \"background\"\n"
    );
    let file = SystemFile::parse(&text).unwrap();
    let of = |name| file.topics().iter().find(|t| t.name == name).map(|t| (t.priority, t.express)).unwrap();
    assert_eq!(of("/cmd_vel"), (Some(LinkPriority::RealTime), true));
    assert_eq!(of("/map"), (Some(LinkPriority::Background), false));
    assert_eq!(of("/scan"), (None, false));
    assert!(LinkPriority::ALL.is_sorted());
    let wrong = problems(&format!(
        "{GOOD}\n[topics.\"/x\"]\npriority = \"realtime\"\n[topics.\"/y\"]\nexpress = true\n"
    ));
    assert!(
        wrong.iter().any(|p| p.contains("unknown `priority` \"realtime\"") && p.contains("`real_time`")),
        "{wrong:?}"
    );
    assert!(wrong.iter().any(|p| p.contains("topic `/y` is `express` without a `priority`")), "{wrong:?}");
}

#[test]
fn unknown_key() {
    expect(
        &with("wcet = \"3ms\"", "wect = \"3ms\""),
        &[
            (15, "callback `plan` lacks `wcet`"),
            (18, "1: unknown key `wect` in callback `plan`: did you mean `wcet`?"),
        ],
    );
    expect(
        &with("cores = 2", "cores = 2\nrack = 1"),
        &[(4, "unknown key `rack` in host `robot` (known: cores, ")],
    );
}

#[test]
fn missing_topic() {
    expect(
        &with("topic = \"/scan\"", "topic = \"/scna\""),
        &[
            (17, "callback `plan` uses topic `/scna`, which does not exist: did you mean `/scan`?"),
            // Its chain is broken, too.
            (26, "goes from `scan` to `plan`, which neither is triggered by nor reads"),
        ],
    );
    expect(
        &with("{ period = \"20ms\" }", "{}"),
        &[(22, "topic `/joy`, used by callback `drive`, has no publisher")],
    );
}

#[test]
fn circle_of_triggers() {
    let circle = with("period = \"10ms\"", "topic = \"/path\"");
    expect(&circle, &[(10, "callbacks `plan`, `scan` trigger one another in a circle")]);
    let own = with(
        "publishes = \"/scan\"",
        "publishes = \"/scan\"\n[callbacks.echo]\nnode = \"driver\"\ntopic = \"/e\"\nwcet = \"1ms\"\npublishes = \"/e\"",
    );
    expect(&own, &[(15, "callbacks `echo` trigger one another in a circle")]);
}

#[test]
fn the_greatest_input_is_kept_and_changes_no_bound() {
    let with_input = |value: &str| with("wcet = \"2ms\"", &format!("wcet = \"2ms\"\ninput_max = {value}"));
    let [plain, stated] = [GOOD, &with_input("65_536")].map(|text| SystemFile::parse(text).unwrap().check());
    let sizes: Vec<_> = stated.callbacks.iter().map(|callback| callback.entry.input_max).collect();
    assert_eq!(sizes, [Some(65_536), None, None]);
    let bounds = |checked: &CheckedSystem| -> Vec<_> {
        checked.callbacks.iter().map(|c| c.response_overhead_ns).collect()
    };
    assert_eq!(bounds(&plain), bounds(&stated));
    for (value, problem) in [
        ("0", "`input_max` of callback `scan` is 0, out of range: set it to 1 or more"),
        ("-5", "`input_max` of callback `scan` is -5, out of range"),
        ("1.5", "`input_max` must be a whole number, not a number with a fraction"),
        ("\"64 KiB\"", "`input_max` must be a whole number, not a string"),
    ] {
        expect(&with_input(value), &[(14, problem)]);
    }
}

#[test]
fn period_of_zero() {
    expect(
        &with("period = \"10ms\"", "period = \"0ms\""),
        &[(12, "`period` of callback `scan` is 0: set a time above it")],
    );
}

#[test]
fn an_empty_list_of_topics_is_no_trigger() {
    let text =
        "[hosts.h]\ncores = 1\n[nodes.n]\n[callbacks.low]\ntopic = []\nwcet = \"10us\"\npriority = 10\n";
    expect(text, &[(5, "`topic` of callback `low` is empty: name a topic, or use `period`")]);
}

#[test]
fn wcet_over_period() {
    expect(
        &with("wcet = \"2ms\"", "wcet = \"10.5ms\""),
        &[(13, "`wcet` of callback `scan` is 10.5 ms, more than its period of 10 ms")],
    );
    // The period may be that of whoever triggers it.
    expect(
        &with("wcet = \"3ms\"", "wcet = \"11ms\""),
        &[(18, "`wcet` of callback `plan` is 11 ms, more than its period of 10 ms")],
    );
}

#[test]
fn two_threads_of_one_priority() {
    let stated = |more: &str| {
        let plan = with("wcet = \"3ms\"", &format!("wcet = \"3ms\"\npriority = 7\n{more}"));
        plan.replacen("wcet = \"1ms\"", &format!("wcet = \"1ms\"\npriority = 7\n{more}"), 1)
    };
    expect(&stated(""), &[(26, "`plan` and `drive` have priority 7 on one core")]);
    let meant = SystemFile::parse(&stated("shares_priority = true")).unwrap().check();
    assert!(
        meant.warnings.iter().any(|w| w.contains("`drive` and `plan` share priority 7")),
        "{:?}",
        meant.warnings
    );
}

#[test]
fn cores_and_priorities_that_do_not_exist() {
    expect(
        &with("core = 1", "core = 2"),
        &[(7, "node `control` is on core 2, which host `robot` does not have: use one of 0, 1")],
    );
    for priority in ["0", "100", "-3"] {
        let text = with("wcet = \"2ms\"", &format!("wcet = \"2ms\"\npriority = {priority}"));
        expect(&text, &[(14, "out of range: set it to 1 (lowest) to 99")]);
    }
}

#[test]
fn callback_without_trigger_or_with_two() {
    expect(
        &with("period = \"10ms\"\n", ""),
        &[(10, "callback `scan` has no trigger: add `topic`, `all` or `period`")],
    );
    let both = with("period = \"10ms\"", "period = \"10ms\"\ntopic = \"/joy\"");
    expect(&both, &[(12, "callback `scan` has two triggers")]);
}

#[test]
fn hosts_need_remote_topics_and_a_network() {
    let text = with("[nodes.driver]", "[hosts.other]\ncores = 1\n[nodes.driver]\nhost = \"other\"").replacen(
        "[nodes.control]",
        "[nodes.control]\nhost = \"robot\"",
        1,
    );
    expect(
        &text,
        &[
            (21, "is not remote: add `remote = true`"),
            (21, "add `latency = [shortest, longest]` to [network]"),
        ],
    );
}

#[test]
fn each_host_says_what_happens_to_what_the_file_does_not_list() {
    let refuses = |text: &str| {
        let file = SystemFile::parse(text).unwrap_or_else(|problems| panic!("{problems}"));
        file.cores().iter().map(|core| core.refuses_unlisted).collect::<Vec<_>>()
    };
    let stated = |value: &str| with("cores = 2", &format!("cores = 2\nunlisted = \"{value}\""));
    assert_eq!(refuses(GOOD), [false, false]);
    assert_eq!(refuses(&stated("warn")), [false, false]);
    assert_eq!(refuses(&stated("refuse")), [true, true]);
    expect(
        &stated("refused"),
        &[(4, "unknown `unlisted` \"refused\" in host `robot`: did you mean `refuse`?")],
    );
}

#[test]
fn locks_and_groups() {
    let lock = "locks = [{ resource = \"map\", length = \"1ms\" }]";
    let across = with("wcet = \"2ms\"", &format!("wcet = \"2ms\"\n{lock}")).replacen(
        "wcet = \"1ms\"",
        &format!("wcet = \"1ms\"\n{lock}"),
        1,
    );
    expect(&across, &[(21, "`map` is locked by callbacks `scan` and `drive` on different cores")]);
    let alone = with("wcet = \"2ms\"", "wcet = \"2ms\"\ngroup = \"sensor\"");
    expect(&alone, &[(14, "in group `sensor`, which is not in [groups]: add [groups.sensor]")]);
    // An executor of ROS 2 is one thread for the callbacks of several nodes.
    let group = |driver: &str, control: &str| {
        let text = GOOD.replace("wcet = \"1ms\"", "wcet = \"1ms\"\ngroup = \"main\"");
        let text = text.replace("wcet = \"2ms\"", "wcet = \"2ms\"\ngroup = \"main\"");
        let text = text.replacen("core = 0", driver, 1).replacen("core = 1", control, 1);
        text.replace("[[chains]]", "[groups.main]\n[[chains]]")
    };
    let ros = "core = 0\nclient = \"rclcpp\"";
    expect(&group(ros, "core = 0\nclient = \"rclpy\""), &[]);
    expect(
        &group(ros, "core = 0"),
        &[(22, "`scan` and `drive` of group `main` are not of one node: only an executor of ROS 2")],
    );
    expect(
        &group(ros, "core = 1\nclient = \"rclcpp\""),
        &[(23, "`scan` and `drive` of group `main` are not on one core: a group is one thread")],
    );
}

#[test]
fn values_of_the_wrong_kind() {
    expect(
        &with("period = \"10ms\"", "period = 10"),
        &[(12, "`period` must be a time with its unit, such as \"1.5ms\", not a number")],
    );
    expect(&with("wcet = \"2ms\"", "wcet = \"2 minutes\""), &[(13, "`wcet` is not a time: \"2 minutes\"")]);
    expect(
        &with("cores = 2", "cores = \"two\"\n"),
        &[(3, "`cores` must be a whole number, not a string"), (6, "core 0"), (8, "core 1")],
    );
    expect("[hosts.robot\n", &[(1, "")]);
    assert_eq!(problems("").len(), 3, "no host, no node, no callback");
}

#[test]
fn everything_at_once() {
    let text = r#"
[hosts.robot]
coers = 1
cores = 2
[nodes.n]
core = 0
[callbacks.a]
topic = "/nowhere"
wcet = "1ms"
priority = 120
[callbacks.b]
period = "0ms"
wcet = "1ms"
[callbacks.c]
period = "5ms"
wcet = "6ms"
priority = 9
[callbacks.d]
period = "5ms"
wcet = "1ms"
priority = 9
core = 5
[callbacks.e]
wcet = "1ms"
priority = 9
[callbacks.f]
topic = "/g"
wcet = "1ms"
publishes = "/f"
[callbacks.g]
topic = "/f"
wcet = "1ms"
publishes = "/g"
"#;
    expect(
        text,
        &[
            (3, "unknown key `coers`"),
            (8, "`/nowhere`, which does not exist"),
            (10, "is 120, out of range"),
            (12, "`period` of callback `b` is 0"),
            (16, "more than its period"),
            (22, "callback `d` is on core 5"),
            (23, "callback `e` has no trigger"),
            (25, "`c` and `e` have priority 9"),
            (26, "trigger one another in a circle"),
        ],
    );
}

#[test]
fn overload_and_shallow_queues_are_explained() {
    let overloaded = SystemFile::parse(&with("wcet = \"3ms\"", "wcet = \"9.9ms\"")).unwrap().check();
    assert!(!overloaded.schedulable);
    assert!(
        overloaded.warnings.iter().any(|w| w.contains("114.0 % of the core")),
        "{:?}",
        overloaded.warnings
    );
    assert_eq!((overloaded.callbacks[2].response_overhead_ns, overloaded.chains[0].latency_ns), (None, None));

    let shallow = with("\"/joy\" = { period = \"20ms\" }", "\"/joy\" = { period = \"20ms\", depth = 1 }");
    let checked = SystemFile::parse(&shallow).unwrap().check();
    assert!(checked.schedulable);
    assert!(checked.warnings.iter().any(|w| w.contains("needs a queue of 2, but its topic keeps 1")));
}

#[test]
fn damaged_files_never_panic() {
    let mut rng = tautline_seed::random();
    let lines: Vec<&str> = GOOD.lines().collect();
    let times = ["0ms", "1ns", "584y", "18446744073709551615ns", "9999999999s", "-1ms"];
    let (mut good, mut bad) = (0, 0);
    for _ in 0..3_000 {
        let mut text: Vec<String> = lines.iter().map(|line| line.to_string()).collect();
        for _ in 0..rng.random_range(1..4) {
            let (i, j) = (rng.random_range(0..text.len()), rng.random_range(0..lines.len()));
            match rng.random_range(0..4) {
                0 => drop(text.remove(i)),
                1 => text.insert(i, lines[j].into()),
                2 => {
                    text[i] =
                        text[i].replace("ms\"", &format!("{}\"", times[rng.random_range(0..times.len())]))
                }
                _ => text[i] = text[i].chars().skip(rng.random_range(0..3)).collect(),
            }
        }
        match SystemFile::parse(&text.join("\n")) {
            Ok(file) => {
                let checked = file.check();
                assert_eq!(checked.callbacks.len(), file.callbacks().len());
                good += 1;
            }
            Err(problems) => {
                assert!(!problems.0.is_empty());
                bad += 1;
            }
        }
    }
    assert!(good > 50 && bad > 1_000, "{good} {bad}");
}

#[test]
fn a_thousand_callbacks_on_eight_cores() {
    let period_ms = |chain: usize| 5 + 3 * (chain % 75);
    let mut text = String::from("[hosts.big]\ncores = 8\n[overheads]\nper_message = \"5us\"\n[nodes.n]\n");
    for i in 0..1_000 {
        // 125 chains of eight callbacks, each on the next core.
        let (chain, stage) = (i / 8, i % 8);
        let period = period_ms(chain);
        let wcet = period * 1_000_000 / 180;
        let trigger = match stage {
            0 => format!("period = \"{period}ms\""),
            _ => format!("topic = \"/t{}\"", i - 1),
        };
        writeln!(
            text,
            "[callbacks.c{i}]\n{trigger}\nwcet = \"{wcet}ns\"\nbcet = \"{wcet}ns\"\ncore = {}",
            i % 8
        )
        .unwrap();
        writeln!(text, "publishes = \"/t{i}\"\ndeadline = \"{}ms\"", period * 3).unwrap();
    }
    for chain in 0..125 {
        let path: Vec<_> = (0..8).map(|stage| format!("\"c{}\"", chain * 8 + stage)).collect();
        let deadline = period_ms(chain) * 16;
        writeln!(
            text,
            "[[chains]]\nname = \"{chain}\"\npath = [{}]\ndeadline = \"{deadline}ms\"",
            path.join(", ")
        )
        .unwrap();
    }
    let begun = Instant::now();
    let file = SystemFile::parse(&text).unwrap_or_else(|problems| panic!("{problems}"));
    let parsed = begun.elapsed();
    let checked = file.check();
    println!("1,000 callbacks: read in {parsed:?}, checked in {:?}", begun.elapsed() - parsed);
    let bounded = checked.callbacks.iter().filter(|c| c.response_overhead_ns.is_some()).count();
    println!("{bounded} bounds; {:?}", checked.warnings.first());
    assert_eq!(bounded, 1_000);
}

#[test]
fn an_executor_without_a_bound_is_named_with_the_callbacks_that_it_leaves_without() {
    let text = |executor: &str, order: &str| {
        format!(
            "[hosts.robot]\ncores = 1\n[overheads]\nper_message = \"10us\"\nrclcpp = \"10us\"\n\
             [nodes.ros]\nclient = \"rclcpp\"\nexecutor = \"{executor}\"\n[nodes.own]\n\
             [topics.\"/scan\"]\nperiod = \"20ms\"\n[groups.main]\npriority = 20\n{order}\n\
             [callbacks.high]\nnode = \"own\"\nperiod = \"10ms\"\nwcet = \"1ms\"\npriority = 30\n\
             [callbacks.scan]\nnode = \"ros\"\ngroup = \"main\"\ntopic = \"/scan\"\nwcet = \"1ms\"\n{}\n\
             [callbacks.tick]\nnode = \"ros\"\ngroup = \"main\"\nperiod = \"20ms\"\nwcet = \"1ms\"\n\
             [callbacks.low]\nnode = \"own\"\nperiod = \"40ms\"\nwcet = \"1ms\"\npriority = 10\n",
            if order.is_empty() { "" } else { "priority = 1" }
        )
    };
    let checked = |executor: &str, order: &str| {
        SystemFile::parse(&text(executor, order)).unwrap_or_else(|problems| panic!("{problems}")).check()
    };
    let ranked = "order = \"priority\"";
    for (executor, order, without, why) in [
        ("single-threaded", "", &[][..], ""),
        ("single-threaded", ranked, &[], ""),
        ("static-single-threaded", "", &[], ""),
        ("static-single-threaded", ranked, &["tick"], "takes the messages of all priorities"),
        ("events", "", &["scan", "tick"], "an EventsExecutor gets its messages"),
        // Its polling takes time from lower priorities, and from no others.
        ("multi-threaded", "", &["scan", "tick", "low"], "the threads of a MultiThreadedExecutor"),
    ] {
        let checked = checked(executor, order);
        let unbounded = checked.callbacks.iter().filter(|callback| callback.response_overhead_ns.is_none());
        let unbounded: Vec<_> = unbounded.map(|callback| callback.entry.name.as_str()).collect();
        assert_eq!(unbounded, without, "{executor} {order}: {:?}", checked.warnings);
        assert_eq!(checked.schedulable, without.is_empty(), "{executor} {order}: {:?}", checked.warnings);
        let is_named = |warning: &String| warning.contains(why) && warning.contains("per callback group");
        assert!(without.is_empty() || checked.warnings.iter().any(is_named), "{:?}", checked.warnings);
        let of = |callback: &&CheckedCallback| callback.response_ns.is_none();
        let free: Vec<_> = checked.callbacks.iter().filter(of).map(|callback| &callback.entry.name).collect();
        assert_eq!(free, without, "without overheads, either");
    }
    for executor in ["events", "multi-threaded"] {
        let part = format!(
            "group `main` has `order = \"priority\"`, which a node's `executor = \"{executor}\"` does not"
        );
        expect(&text(executor, ranked), &[(14, &part)]);
    }
    let own = text("events", "").replace("client = \"rclcpp\"", "client = \"tautline\"");
    let found = problems(&own).join("\n");
    assert!(found.contains("node `ros` has an `executor`, but Tautline runs its callbacks"), "{found}");
}

/// By hand: 2 ms of its own, 2 x 10 us of switches, 300 us of the executor, 100 us per message of both.
#[test]
fn a_client_librarys_executor_is_charged_to_the_thread_of_its_callbacks() {
    let text = |client: &str| {
        format!(
            "[hosts.robot]\ncores = 1\n[overheads]\ncontext_switch = \"10us\"\nper_message = \"50us\"\nrclcpp = \"300us\"\n\
             [nodes.ros]\nclient = \"{client}\"\n[nodes.own]\n\
             [callbacks.high]\nnode = \"ros\"\nperiod = \"10ms\"\nwcet = \"2ms\"\npriority = 20\n\
             [callbacks.low]\nnode = \"own\"\nperiod = \"20ms\"\nwcet = \"1ms\"\npriority = 10\n"
        )
    };
    let found = |client: &str| {
        let checked =
            SystemFile::parse(&text(client)).unwrap_or_else(|problems| panic!("{problems}")).check();
        let of = |c: &CheckedCallback| (c.wcet_ns, c.charged_ns, c.response_ns, c.response_overhead_ns);
        checked.callbacks.iter().map(of).collect::<Vec<_>>()
    };
    let own = found("tautline");
    assert_eq!(own[0], (2_000_000, 2_070_000, Some(2_000_000), Some(2_120_000)));
    assert_eq!(own[1], (1_000_000, 1_070_000, Some(3_000_000), Some(3_140_000)));
    assert_eq!(found("rclpy"), own, "the file states no cost of rclpy");
    let warnings = SystemFile::parse(&text("rclpy")).unwrap().check().warnings;
    assert!(warnings.iter().any(|warning| warning.contains("add `rclpy = ")), "{warnings:?}");
    let rclcpp = found("rclcpp");
    assert_eq!(rclcpp[0], (2_000_000, 2_370_000, Some(2_000_000), Some(2_420_000)));
    assert_eq!(rclcpp[1], (1_000_000, 1_070_000, Some(3_000_000), Some(3_440_000)));
    let problems = SystemFile::parse(&text("rclccp")).unwrap_err().to_string();
    assert!(
        problems.contains("unknown `client` \"rclccp\"") && problems.contains("did you mean `rclcpp`"),
        "{problems}"
    );
}

#[test]
fn a_process_is_on_the_host_that_it_says_or_on_the_only_one() {
    let text = |hosts: &str| {
        format!("{hosts}[nodes.n]\nhost = \"a\"\n[callbacks.c]\nperiod = \"1ms\"\nwcet = \"1us\"\n")
    };
    let one = SystemFile::parse(&text("[hosts.a]\ncores = 1\n")).unwrap();
    assert_eq!((one.host(None), one.host(Some("a"))), (Ok("a"), Ok("a")));
    assert_eq!(one.host(Some("b")), Err(vec!["a"]));
    let two = SystemFile::parse(&text("[hosts.a]\ncores = 1\n[hosts.b]\ncores = 2\n")).unwrap();
    assert_eq!((two.host(Some("b")), two.host(None)), (Ok("b"), Err(vec!["a", "b"])));
}

#[test]
fn a_callback_that_is_demoted_costs_what_the_file_says_and_has_a_thread_of_its_own() {
    let overrun = |text: &str| with("wcet = \"3ms\"", &format!("wcet = \"3ms\"\n{text}"));
    let file = overrun("overrun = \"demote\"") + "[overheads]\ndemotion = \"20us\"\nper_message = \"1us\"\n";
    let checked = SystemFile::parse(&file).unwrap().check();
    let of =
        |name: &str| checked.callbacks.iter().find(|callback| callback.entry.name == name).unwrap().clone();
    assert_eq!(of("plan").entry.overrun, OverrunPolicy::Demote);
    assert_eq!(of("scan").entry.overrun, OverrunPolicy::Tell);
    assert_eq!((of("plan").charged_ns, of("scan").charged_ns), (3_021_000, 2_001_000));
    assert!(!checked.warnings.iter().any(|warning| warning.contains("demotion")), "{:?}", checked.warnings);
    for policy in OverrunPolicy::ALL {
        let stated = overrun(&format!("overrun = \"{}\"", policy.as_str()));
        let checked = SystemFile::parse(&stated).unwrap().check();
        let plan = checked.callbacks.iter().find(|callback| callback.entry.name == "plan").unwrap();
        assert_eq!(plan.entry.overrun, policy);
    }
    let free = SystemFile::parse(&overrun("overrun = \"demote\"")).unwrap().check();
    assert!(free.warnings.iter().any(|warning| warning.contains("add `demotion = ")), "{:?}", free.warnings);

    expect(
        &overrun("overrun = \"stop\""),
        &[(19, "unknown `overrun` \"stop\" in callback `plan` (known: tell, demote, suspend, end)")],
    );
    let grouped = overrun("overrun = \"demote\"\ngroup = \"g\"") + "[groups.g]\n";
    expect(&grouped, &[(19, "callback `plan` has `overrun = \"demote\"`, but shares its thread")]);
    let foreign = |policy: &str| {
        overrun(&format!("overrun = \"{policy}\"")).replace("core = 1", "core = 1\nclient = \"rclcpp\"")
    };
    assert!(SystemFile::parse(&foreign("demote")).is_ok());
    for policy in ["suspend", "end"] {
        expect(&foreign(policy), &[(20, "which can neither sleep nor end in a callback: say \"demote\"")]);
    }
    let events =
        foreign("demote").replace("client = \"rclcpp\"", "client = \"rclcpp\"\nexecutor = \"events\"");
    expect(&events, &[(21, "but is run by an EventsExecutor, where rmw_tautline sees no end of a callback")]);
    let timer = "[hosts.h]\ncores = 1\n[nodes.n]\nclient = \"rclpy\"\n[callbacks.t]\nperiod = \"1s\"\nwcet = \"1ms\"\n\
                 overrun = \"demote\"\n";
    expect(timer, &[(8, "is a timer of ROS 2's")]);
    let locked = overrun("overrun = \"suspend\"\nlocks = [{ resource = \"map\", length = \"1ms\" }]");
    expect(&locked, &[(19, "callback `plan` has `overrun = \"suspend\"`, but takes locks")]);
}

#[test]
fn a_reservation_is_read_and_delays_all_cores_that_it_may_run_on() {
    let text = |core: &str| {
        format!(
            "[hosts.robot]\ncores = 2\n[nodes.n]\ncore = 0\n\
             [callbacks.points]\nperiod = \"20ms\"\nwcet = \"4ms\"\ncore = {core}\n\
             reservation = {{ runtime = \"5ms\", period = \"20ms\" }}\n\
             [callbacks.near]\nperiod = \"50ms\"\nwcet = \"10ms\"\n\
             [callbacks.far]\nperiod = \"50ms\"\nwcet = \"10ms\"\ncore = 1\n"
        )
    };
    let check = |core| {
        let checked = SystemFile::parse(&text(core)).unwrap().check();
        let responses: Vec<_> =
            checked.callbacks.iter().map(|of| of.response_ns.unwrap() / 1_000_000).collect();
        (checked.callbacks[0].clone(), responses)
    };
    let (points, responses) = check("0");
    let reservation = Reservation { runtime_ns: 5_000_000, period_ns: 20_000_000 };
    let entry = &points.entry;
    assert_eq!((entry.reservation, entry.priority, entry.floats), (Some(reservation), 100, false));
    assert_eq!(responses, [4, 20, 10]);
    let (points, responses) = check("\"any\"");
    assert!(points.entry.floats && points.entry.tasks.len() == 1);
    assert_eq!(responses, [4, 20, 20]);
}

#[test]
fn reservations_that_cannot_be_are_refused() {
    let reserved = |more: &str| {
        let reservation = "reservation = { runtime = \"4ms\", period = \"20ms\" }";
        with("wcet = \"3ms\"", &format!("wcet = \"3ms\"\n{reservation}\n{more}"))
    };
    for (more, what) in [
        ("priority = 4", "which is above every priority"),
        ("overrun = \"demote\"", "to which the kernel holds it"),
        ("locks = [{ resource = \"map\", length = \"1ms\" }]", "but takes locks"),
        ("non_preemptive = \"1ms\"", "whose end preempts everything"),
    ] {
        expect(&reserved(more), &[(19, what)]);
    }
    let with = |text: &str| with("wcet = \"3ms\"", &format!("wcet = \"3ms\"\n{text}"));
    expect(&with("core = \"any\""), &[(19, "which only one with a `reservation` may be")]);
    for (wrong, what) in [
        ("{ runtime = \"4ms\" }", "lacks `period`"),
        ("{ runtime = \"30ms\", period = \"20ms\" }", "exceeds its `period`"),
        ("{ runtime = \"1us\", period = \"20ms\" }", "out of range"),
        ("{ runtime = \"1ms\", period = \"5s\" }", "out of range"),
        ("\"4ms\"", "must be a table"),
    ] {
        let problems = SystemFile::parse(&with(&format!("reservation = {wrong}"))).unwrap_err().to_string();
        assert!(problems.contains(what), "{problems}");
    }
    let two = |cores: [&str; 2]| {
        let callback = |name: &str, core: &str| {
            format!(
                "[callbacks.{name}]\nperiod = \"20ms\"\nwcet = \"1ms\"\ncore = {core}\n\
                 reservation = {{ runtime = \"2ms\", period = \"20ms\" }}\n"
            )
        };
        let hosts = "[hosts.robot]\ncores = 2\n[nodes.n]\n";
        SystemFile::parse(&format!("{hosts}{}{}", callback("a", cores[0]), callback("b", cores[1])))
    };
    assert!(two(["0", "1"]).is_ok() && two(["\"any\"", "\"any\""]).is_ok());
    assert!(two(["0", "0"]).unwrap_err().to_string().contains("there may be one on a core"));
    assert!(two(["0", "\"any\""]).unwrap_err().to_string().contains("only one of both is on any core"));
}

/// The ways double with each join of two topics of one publisher.
#[test]
fn a_chain_of_too_many_ways_is_refused() {
    let mut text = "[hosts.h]\ncores = 1\n[nodes.n]\n[callbacks]\n".to_owned();
    text += "j0 = { period = \"1s\", wcet = \"1us\", publishes = [\"a0\", \"b0\"] }\n";
    for stage in 1..=40 {
        let from = stage - 1;
        writeln!(
            text,
            "j{stage} = {{ all = [\"a{from}\", \"b{from}\"], wcet = \"1us\", publishes = [\"a{stage}\", \"b{stage}\"] }}"
        )
        .unwrap();
    }
    let path: Vec<_> = (0..=40).map(|stage| format!("\"j{stage}\"")).collect();
    write!(text, "[[chains]]\nname = \"c\"\npath = [{}]\ndeadline = \"1s\"\n", path.join(", ")).unwrap();
    let refused = SystemFile::parse(&text).unwrap_err().to_string();
    assert!(refused.contains("chain `c` has more than 4096 ways"), "{refused}");
}
