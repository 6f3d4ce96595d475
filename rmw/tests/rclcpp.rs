// SPDX-License-Identifier: MIT OR Apache-2.0
//! examples/rclcpp, which knows nothing of Tautline, under its system files: built and run where a ROS 2 with rclcpp is sourced.

mod support;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use support::{Domain, built, may_be_realtime, on_tautline, wait_until, words_of};

const SECONDS: &str = "2";

fn taut(arguments: &[&str]) -> String {
    let mut command = Command::new(built("taut", "taut").unwrap());
    words_of(command.args(arguments).env("TAUT_SCOPE", support::scope())).1
}

/// The first prefix of the environment that has rclcpp; prints why a test is skipped without.
fn with_rclcpp() -> Option<PathBuf> {
    let prefixes = ["AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"].map(std::env::var_os);
    let mut prefixes = prefixes.iter().flatten().flat_map(std::env::split_paths);
    let found = prefixes.find(|prefix| prefix.join("share/rclcpp/cmake/rclcppConfig.cmake").is_file());
    if found.is_none() {
        eprintln!(
            "skipped: neither AMENT_PREFIX_PATH nor CMAKE_PREFIX_PATH has rclcpp: source a ROS 2 that has it"
        );
    }
    found
}

/// Builds the example as colcon does.
fn five_topics() -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/rclcpp");
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("examples_rclcpp");
    let cmake = |command: &mut Command| {
        let (is_done, out, errors) = words_of(command);
        assert!(is_done, "{command:?}: {out}{errors}");
    };
    cmake(Command::new("cmake").arg("-S").arg(source).arg("-B").arg(&folder));
    cmake(Command::new("cmake").arg("--build").arg(&folder));
    folder.join("five_topics")
}

/// Ended with the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// 90 % of a core, in five executors and in one whose order the RMW makes: nothing is late, nothing lost. Bounds are less than what a busy
/// machine may add to them; docs/rmw.md has what was measured.
#[test]
fn five_topics_of_rclcpp_meet_their_deadlines() {
    let (Some(prefix), Some(_)) = (with_rclcpp(), built("taut", "taut")) else { return };
    if !may_be_realtime() {
        return;
    }
    let Some(domain) = Domain::new(99) else { return };
    let program = five_topics();
    let mut libraries = vec![prefix.join("lib")];
    libraries.extend(std::env::var_os("LD_LIBRARY_PATH").iter().flat_map(std::env::split_paths));
    let start = |arguments: &[&str]| {
        let mut command = Command::new(&program);
        command.args(arguments).env("ROS_DOMAIN_ID", domain.number.to_string());
        command.env("LD_LIBRARY_PATH", std::env::join_paths(&libraries).unwrap());
        on_tautline(&mut command);
        command
    };
    for (role, threads) in [("five", 5), ("one", 1)] {
        let text = std::fs::read_to_string(format!("../examples/rclcpp/{role}.toml")).unwrap();
        // Wherever the tests run there is such a core.
        let text = text.replace("cores = [1]", "cores = [0]").replace("core = 1", "core = 0");
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        let steal_before = tautline_rt::host::steal_ticks(None);
        let said = tempfile::NamedTempFile::new().unwrap();
        let mut subscriber = start(&[role]);
        subscriber.env("TAUT_SYSTEM", file.path()).stdout(Stdio::null()).stderr(said.reopen().unwrap());
        let mut subscriber = Running(subscriber.spawn().unwrap());
        // What comes before a thread waits is not counted.
        wait_until("all threads to wait", || {
            let said = std::fs::read_to_string(said.path()).unwrap();
            said.matches("of the system file: SCHED_FIFO").count() == threads
        });
        assert!(start(&["publisher", "0", SECONDS]).status().unwrap().success());
        let report = || -> Value {
            let said = taut(&["report", "--json", "--domain", &domain.number.to_string()]);
            serde_json::from_str(&said).unwrap_or_else(|error| panic!("{error}: {said}"))
        };
        wait_until("200 ms' and all other jobs", || {
            let jobs = |row: &Value| row["measured"]["jobs"].as_u64().unwrap_or(0);
            let found = report()["callbacks"].as_array().unwrap().iter().map(jobs).collect::<Vec<_>>();
            found == [200, 100, 40, 20, 10]
        });
        let report = report();
        eprintln!("{}", taut(&["report", "--domain", &domain.number.to_string()]));
        let steal_ms = 10.0 * (tautline_rt::host::steal_ticks(None) - steal_before) as f64;
        kill_process(Pid::from_child(&subscriber.0), Signal::INT).unwrap();
        assert!(subscriber.0.wait().unwrap().success());
        assert_eq!((&report["realtime"], &report["unknown"]), (&json!(true), &json!([])), "{report}");
        for row in report["callbacks"].as_array().unwrap() {
            let of = |side: &str, name: &str| row[side][name].as_f64().unwrap_or(f64::INFINITY);
            let deadline_ms = of("predicted", "deadline_ms");
            assert!(of("predicted", "response_ms") <= deadline_ms, "{row}");
            assert!(
                row["measured"]["response_ms"]["max"].as_f64().unwrap() <= deadline_ms + steal_ms,
                "{row}"
            );
            assert_eq!(row["measured"]["lost"], 0, "{row}");
        }
    }
}
