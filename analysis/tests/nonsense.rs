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

/// It runs no more often than the slowest of its topics has messages.
#[test]
fn a_join_may_take_longer_than_the_period_of_its_fastest_topic() {
    let join = |wcet: &str, policy: &str| {
        let fuse = format!(
            "all = [\"/scan\", \"/cloud\"]\n{policy}\ndeadline = \"100ms\"\npriority = 5\npublishes = \"/fused\"\n\
             wcet = \"{wcet}\"\n[callbacks.show]\npriority = 4\ntopic = \"/fused\""
        );
        with("topic = \"/scan\"", &fuse) + "[topics]\n\"/cloud\" = { period = \"100ms\" }\n"
    };
    let checked =
        SystemFile::parse(&join("20ms", "")).unwrap_or_else(|problems| panic!("{problems}")).check();
    let fuse = &checked.callbacks[1];
    assert!(fuse.entry.name == "plan" && fuse.met, "{fuse:?}");
    // What it triggers has its period.
    let show = join("20ms", "").replace("wcet = \"3ms\"", "wcet = \"15ms\"");
    assert!(SystemFile::parse(&show).is_ok());
    refuses(&join("101ms", ""), 14, "`wcet` of callback `plan` is 101 ms, more than its period of 100 ms");
    let show = join("20ms", "").replace("wcet = \"3ms\"", "wcet = \"101ms\"");
    refuses(&show, 18, "`wcet` of callback `show` is 101 ms, more than its period of 100 ms");
    let paced = join("20ms", "policy = \"latest_time\"");
    refuses(&paced, 14, "`wcet` of callback `plan` is 20 ms, more than its period of 10 ms");
}

/// With it the node does not start.
#[test]
fn a_queue_that_no_topic_has_is_no_queue() {
    let text = |stall: &str, depth: &str| {
        format!(
            "[hosts.h]\ncores = 1\nstall = \"{stall}\"\n[nodes.n]\n[topics]\nt = {{ period = \"100us\"{depth} }}\n\
             [callbacks.c]\ntopic = \"t\"\nwcet = \"10us\"\n"
        )
    };
    for (depth, good) in [("0", false), ("1", true), ("65536", true), ("65537", false), ("-1", false)] {
        let parsed = SystemFile::parse(&text("1ms", &format!(", depth = {depth}")));
        assert_eq!(parsed.is_ok(), good, "{depth}");
        let said = format!("`depth` of topic `t` is {depth}: set it to \"auto\", or to 1 to 65536");
        assert!(parsed.err().is_none_or(|problems| problems.to_string().contains(&said)), "{depth}");
    }
    // 8.00001 s, of which each 100 us bring a message.
    for (stall, depth, good) in [("6s", "", true), ("8s", "", false), ("8s", ", depth = 1", true)] {
        let checked = SystemFile::parse(&text(stall, depth)).unwrap().check();
        assert_eq!(checked.schedulable, good, "{stall} {depth}: {:?}", checked.warnings);
        let said = "callback `c` needs a queue of 80001, but a topic has at most 65536: lower the rate";
        assert_eq!(
            checked.warnings.iter().any(|warning| warning.contains(said)),
            !good,
            "{:?}",
            checked.warnings
        );
    }
}

#[test]
fn no_lock_is_held_for_longer_than_the_callback_takes() {
    let locked = |length: &str| {
        with(
            "wcet = \"3ms\"",
            &format!("wcet = \"3ms\"\nlocks = [{{ resource = \"map\", length = \"{length}\" }}]"),
        )
    };
    assert!(SystemFile::parse(&locked("3ms")).is_ok());
    refuses(&locked("30ms"), 8, "callback `plan` holds lock `map` for 30 ms, longer than its wcet of 3 ms");
}

#[test]
fn what_is_computed_of_a_topic_is_not_stated() {
    let topic = |keys: &str| format!("{GOOD}[topics]\n\"/scan\" = {{ {keys} }}\n");
    assert!(SystemFile::parse(&topic("depth = 3")).is_ok());
    for key in ["jitter", "min_distance"] {
        refuses(
            &topic(&format!("{key} = \"1ms\"")),
            16,
            &format!("`{key}` of topic `/scan` needs a `period`"),
        );
    }
}

#[test]
fn a_kernel_without_a_limit_is_not_one_that_allows_nothing() {
    let throttling = |runtime: &str| {
        format!("{GOOD}[overheads]\nthrottling = {{ period = \"1s\", runtime = \"{runtime}\" }}\n")
    };
    assert!(SystemFile::parse(&throttling("950ms")).is_ok());
    refuses(&throttling("0ms"), 16, "`throttling` has a `runtime` of 0, with which no real-time thread runs");
}

/// rmw_tautline gave one thread the other's priority.
#[test]
fn a_callback_and_a_group_of_others_do_not_share_a_name() {
    let text = |group: &str| {
        let scan = with("wcet = \"2ms\"", &format!("wcet = \"2ms\"\ngroup = \"{group}\""));
        format!("{scan}[groups.{group}]\npriority = 20\n")
    };
    // A group of one callback that is called as that.
    assert!(SystemFile::parse(&text("scan")).is_ok() && SystemFile::parse(&text("main")).is_ok());
    refuses(&text("plan"), 9, "the threads of callback `plan` and of group `plan` have one name: rename one");
}
