// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut check` and `taut init` as a person or script sees them.

#[path = "support/schemas.rs"]
mod schemas;

use schemas::Checked;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

fn taut(args: &[&str], directory: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_taut")).args(args).current_dir(directory).checked()
}

fn systems() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/systems")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

/// An empty directory of this test's own.
fn scratch(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    directory
}

#[test]
fn the_table_and_the_exit_code_are_the_verdict() {
    let good = taut(&["check", "paper.toml"], &systems());
    let out = text(&good.stdout);
    assert_eq!(good.status.code(), Some(0), "{out}");
    for part in [
        "170.000",
        "174.040",
        "25.960",
        "cb:topic5",
        "Wake-ups: publishers wake cb:topic1, cb:topic2, cb:topic3, cb:topic4, cb:topic5.\n",
        "Schedulable: every deadline is met (5 callbacks, 0 chains).",
    ] {
        assert!(out.contains(part), "{part} in {out}");
    }
    let bad = taut(&["check", "one-thread.toml"], &systems());
    assert_eq!(bad.status.code(), Some(1));
    let verdict = "Not schedulable: callback topic1, callback topic2, callback topic3 may miss the deadline.";
    assert!(text(&bad.stdout).contains(verdict));
}

#[test]
fn files_for_programs_of_rclcpp_are_schedulable() {
    let folder = systems().join("../rclcpp");
    for file in ["five.toml", "one.toml", "reference.toml", "reference_five.toml"] {
        let out = taut(&["check", file], &folder);
        assert_eq!(out.status.code(), Some(0), "{file}: {}{}", text(&out.stdout), text(&out.stderr));
    }
}

#[test]
fn a_host_that_the_file_does_not_have_is_named() {
    let admit = |host: &str, file: &str| {
        let mut taut = Command::new(env!("CARGO_BIN_EXE_taut"));
        let taut = taut.args(["check", file, "--admit", "--domain", "219"]).env("TAUT_HOST", host);
        let out = taut.current_dir(systems()).output().unwrap();
        (out.status.code(), text(&out.stderr))
    };
    let (code, said) = admit("robto", "paper.toml");
    let expected = "paper.toml has no host 'robto': set TAUT_HOST to one of robot\n";
    assert!(code == Some(2) && said.ends_with(expected), "{said}");
    let (code, said) = admit("", "two-hosts.toml");
    assert!(code == Some(2) && said.contains("which of two-hosts.toml's hosts is this?"), "{said}");
}

/// A shell and a script get no number for a response time that nothing bounds.
#[test]
fn callbacks_of_a_multi_threaded_executor_are_named_and_have_no_bound() {
    let directory = scratch("multi-threaded");
    let file = "[hosts.robot]\ncores = 1\n[nodes.ros]\nclient = \"rclcpp\"\nexecutor = \"multi-threaded\"\n\
                [topics.\"/scan\"]\nperiod = \"20ms\"\n\
                [callbacks.scan]\ntopic = \"/scan\"\nwcet = \"1ms\"\n";
    std::fs::write(directory.join("ros.toml"), file).unwrap();
    let table = taut(&["check", "ros.toml"], &directory);
    let out = text(&table.stdout);
    assert_eq!(table.status.code(), Some(1), "{out}{}", text(&table.stderr));
    for part in [
        "task `scan` has no bounded response time: the threads of a MultiThreadedExecutor",
        "use one SingleThreadedExecutor per callback group",
        "Not schedulable: callback scan may miss the deadline.",
    ] {
        assert!(out.contains(part), "{part} in {out}");
    }
    let json = taut(&["check", "ros.toml", "--json"], &directory);
    let json: Value = serde_json::from_slice(&json.stdout).unwrap();
    let scan = &json["callbacks"][0];
    assert_eq!(scan["executor"], "multi-threaded");
    assert!(scan["response_ms"].is_null() && scan["response_overhead_ms"].is_null(), "{scan}");
    let warnings = json["warnings"].as_array().unwrap();
    assert!(
        warnings.iter().any(|warning| warning.as_str().unwrap().contains("MultiThreadedExecutor")),
        "{json}"
    );
    std::fs::remove_dir_all(directory).unwrap();
}

#[test]
fn json_is_the_contract() {
    let out = taut(&["check", "two-hosts.toml", "--json"], &systems());
    assert_eq!(out.status.code(), Some(0));
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    let keys = |value: &Value| {
        let mut keys: Vec<_> = value.as_object().unwrap().keys().cloned().collect();
        keys.sort();
        keys.join(" ")
    };
    assert_eq!(keys(&json), "callbacks chains schedulable warnings");
    assert_eq!(json["schedulable"], true);
    assert_eq!(
        keys(&json["callbacks"][0]),
        "capacity core deadline_ms host name period_ms priority response_ms response_overhead_ms wake_up wcet_ms"
    );
    let wake_ups = ["sampler", "publisher"].map(|by| {
        let callbacks = json["callbacks"].as_array().unwrap().iter();
        callbacks.filter(|callback| callback["wake_up"]["by"] == by).count()
    });
    assert!(wake_ups.iter().all(|count| *count > 0), "{json}");
    let lidar = &json["callbacks"][0]["wake_up"];
    assert_eq!(*lidar, serde_json::json!({ "by": "sampler", "because": "its thread has a timer" }));
    assert_eq!(keys(&json["chains"][0]), "deadline_ms latency_ms name");
    assert_eq!((&json["callbacks"][0]["name"], &json["callbacks"][0]["core"]), (&"lidar".into(), &2.into()));
    assert!(json["chains"][0]["latency_ms"].as_f64().unwrap() < 40.0);

    let out = taut(&["check", "paper.toml", "--json", "--sensitivity"], &systems());
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(json["sensitivity"]["load_without_overheads"], 1.111);
    assert_eq!(json["callbacks"][4]["response_ms"], 170.0);
    assert_eq!(json["callbacks"][4]["response_overhead_ms"], 174.04);
}

/// Of a thread that has the priorities of its callbacks, people and scripts see at which each runs, and the ceiling.
#[test]
fn a_callback_has_the_priority_at_which_it_runs() {
    let directory = scratch("ceiling");
    let file = "[hosts.robot]\ncores = 1\n[nodes.ros]\nclient = \"rclcpp\"\n\
                [topics.\"/image\"]\nperiod = \"20ms\"\n[topics.\"/status\"]\nperiod = \"100ms\"\n\
                [groups.perception]\norder = \"priority\"\nthread_priority = \"callback\"\n\
                [callbacks.detect]\ngroup = \"perception\"\ntopic = \"/image\"\nwcet = \"2ms\"\npriority = 42\n\
                [callbacks.log]\ngroup = \"perception\"\ntopic = \"/status\"\nwcet = \"5ms\"\npriority = 20\n";
    std::fs::write(directory.join("ros.toml"), file).unwrap();
    let out = text(&taut(&["check", "ros.toml", "--svg", "t.svg"], &directory).stdout);
    let row = |name: &str| out.lines().find(|line| line.starts_with(name)).unwrap_or_default();
    assert!(row("detect").contains(" 42 ") && row("log").contains(" 20 "), "{out}");
    assert!(out.contains("they run wait at the highest: cb:perception at 42.\n"), "{out}");
    let svg = std::fs::read_to_string(directory.join("t.svg")).unwrap();
    assert!(svg.contains("detect (42)") && svg.contains("log (20)"), "{svg}");
    let json = taut(&["check", "ros.toml", "--json"], &directory);
    let json: Value = serde_json::from_slice(&json.stdout).unwrap();
    let of = |key: &str| [0, 1].map(|i| json["callbacks"][i][key].clone());
    assert_eq!((of("priority"), of("ceiling")), ([42.into(), 20.into()], [42.into(), 42.into()]));
    std::fs::remove_dir_all(directory).unwrap();
}

#[test]
fn a_stall_that_makes_queues_deeper_is_said() {
    let alks = systems().join("alks");
    let out = text(&taut(&["check", "system.toml"], &alks).stdout);
    assert!(
        out.contains(
            "\nQueues outlast a stall of 50 ms of host robot: 20 of 20 capacities are larger for it.\n"
        ),
        "{out}"
    );
    let json: Value =
        serde_json::from_slice(&taut(&["check", "system.toml", "--json"], &alks).stdout).unwrap();
    assert_eq!(json["stalls"], serde_json::json!([{ "host": "robot", "stall_ms": 50.0 }]));
    let callbacks = json["callbacks"].as_array().unwrap();
    let take = callbacks.iter().find(|callback| callback["name"] == "take_command").unwrap();
    assert_eq!((&take["capacity"], &take["capacity_without_stall"]), (&7.into(), &1.into()));
}

#[test]
fn the_timeline_is_a_picture() {
    let directory = scratch("timeline");
    let file = systems().join("two-hosts.toml");
    let out = taut(&["check", file.to_str().unwrap(), "--svg", "t.svg"], &directory);
    assert_eq!(out.status.code(), Some(0));
    let svg = std::fs::read_to_string(directory.join("t.svg")).unwrap();
    assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n"));
    for part in ["base, core 2", "brain, core 1", "imu (80)", "watchdog (79)"] {
        assert!(svg.contains(part), "{part}");
    }
    assert!(!svg.contains("NaN") && !svg.contains("inf"));
}

#[test]
fn a_bad_file_is_2_with_all_problems_by_line_and_column() {
    let directory = scratch("bad");
    std::fs::write(
        directory.join("system.toml"),
        "[hosts.a]\ncoers = 1\n[nodes.n]\n[callbacks.c]\nwcet = \"1ms\"\n",
    )
    .unwrap();
    let out = taut(&["check"], &directory);
    assert_eq!((out.status.code(), text(&out.stdout).as_str()), (Some(2), ""));
    assert_eq!(
        text(&out.stderr).lines().collect::<Vec<_>>(),
        [
            "system.toml:1:8: host `a` lacks `cores`: add their number, or the list of those to use",
            "system.toml:2:1: unknown key `coers` in host `a`: did you mean `cores`?",
            "system.toml:4:12: callback `c` has no trigger: add `topic`, `all` or `period`",
            "taut: system.toml has 3 problems",
        ]
    );
    let missing = taut(&["check", "nothing.toml"], &directory);
    assert_eq!(missing.status.code(), Some(2));
    assert!(text(&missing.stderr).contains("`nothing.toml` cannot be read"));
}

#[test]
fn init_writes_a_file_that_passes_and_never_overwrites() {
    let directory = scratch("init");
    assert_eq!(taut(&["init"], &directory).status.code(), Some(0));
    let out = taut(&["check"], &directory);
    assert_eq!(out.status.code(), Some(0), "{}{}", text(&out.stdout), text(&out.stderr));
    assert!(!text(&out.stdout).contains("warning"));

    std::fs::write(directory.join("system.toml"), "mine").unwrap();
    let again = taut(&["init"], &directory);
    assert_eq!(again.status.code(), Some(1));
    assert!(text(&again.stderr).contains("exists and is left as it is"));
    assert_eq!(std::fs::read_to_string(directory.join("system.toml")).unwrap(), "mine");
}

#[test]
fn a_file_without_a_version_is_migrated_and_a_newer_one_is_refused() {
    let directory = scratch("migrate");
    let path = directory.join("system.toml");
    let write = |text: &str| std::fs::write(&path, text).unwrap();
    let old = std::fs::read_to_string(systems().join("paper.toml")).unwrap();
    let (head, rest) = old.split_once("\n\n").unwrap();
    write(&old);
    let out = taut(&["check", "--migrate"], &directory);
    assert_eq!((out.status.code(), text(&out.stderr).as_str()), (Some(0), ""));
    let said = "system.toml: from a file without a version to version 1\n  `version = 1` is stated\n";
    assert_eq!(text(&out.stdout), said);
    let migrated = std::fs::read_to_string(&path).unwrap();
    assert_eq!(migrated, format!("{head}\n\nversion = 1\n\n{rest}"));
    let [before, after] =
        ["paper.toml", path.to_str().unwrap()].map(|file| taut(&["check", file], &systems()).stdout);
    assert_eq!(before, after);

    let out = taut(&["check", "--migrate", "--json"], &directory);
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    let nothing = serde_json::json!({ "file": "system.toml", "from": 1, "to": 1, "changes": [] });
    assert_eq!((out.status.code(), json), (Some(0), nothing));
    assert_eq!(std::fs::read_to_string(&path).unwrap(), migrated);

    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let mut check = Command::new(env!("CARGO_BIN_EXE_taut"));
    let out = check.args(["check", "--migrate"]).current_dir(&directory).stdout(full).output().unwrap();
    let words = text(&out.stderr);
    assert!(out.status.code() == Some(2) && words.contains("the result cannot be printed"), "{words}");

    let newer = migrated.replace("version = 1", "version = 7") + "colour = 1\n";
    let refusal = "the file is of version 7, and this Tautline reads version 1: use the newer Tautline that it was written for";
    for (args, said) in [
        (&["check"][..], format!("system.toml:4:11: {refusal}")),
        (&["check", "--migrate"], format!("taut: `system.toml` is not migrated: {refusal}")),
    ] {
        write(&newer);
        let out = taut(args, &directory);
        assert_eq!((out.status.code(), text(&out.stdout).as_str()), (Some(2), ""));
        assert!(text(&out.stderr).starts_with(&said), "{}", text(&out.stderr));
        // Its other keys are of that version, too.
        assert!(!text(&out.stderr).contains("colour"));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), newer);
    }
    for (version, said) in [("\"1\"", "is not a whole number"), ("0", "versions begin with 1")] {
        write(&migrated.replace("version = 1", &format!("version = {version}")));
        let out = taut(&["check", "--migrate"], &directory);
        assert!(out.status.code() == Some(2) && text(&out.stderr).contains(said), "{}", text(&out.stderr));
    }
    std::fs::remove_dir_all(&directory).unwrap();
}
