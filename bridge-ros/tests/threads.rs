// SPDX-License-Identifier: MIT OR Apache-2.0
//! Priorities, read back from the kernel; and the bridge as a part of another program.

mod support;

use serde_json::json;
use support::{BridgeProcess, Peer, STRING, reserve, ros, subscription, wait_until};
use tautline_bridge_ros::{Bridge, Options};
use tautline_rt::permission::{realtime_permitted, test_needs};
use tautline_rt::{Policy, Realtime};
use tautline_transport::{Participant, Qos};

/// Name and policy of each thread of a process: field 41 of its stat is the policy (1: SCHED_FIFO), 40 the priority.
fn threads(pid: u32) -> Vec<(String, Option<u8>)> {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let read = |task: std::fs::DirEntry| {
        let stat = std::fs::read_to_string(task.path().join("stat")).ok()?;
        let (head, tail) = stat.rsplit_once(')')?;
        let fields: Vec<&str> = tail.split_whitespace().collect();
        // The first of these is field 3.
        let (priority, policy) = (fields[37].parse().ok()?, fields[38]);
        Some((head.split_once('(')?.1.to_owned(), (policy == "1").then_some(priority)))
    };
    tasks.filter_map(|task| read(task.unwrap())).collect()
}

/// Whether a thread is Fast DDS's, or Cyclone DDS's.
fn is_rmws(name: &str) -> bool {
    ["dds.", "dq.", "recv"].iter().any(|known| name.starts_with(known)) || ["gc", "tev"].contains(&name)
}

#[test]
fn the_rmws_threads_are_below_those_that_carry_and_above_the_others() {
    let Some(_) = ros() else { return };
    let Some(_) = test_needs(realtime_permitted(42)) else { return };
    let bridge = BridgeProcess::start_with(6, 6, &["--priority", "42"], |_| {});
    let of = |name: &'static str| {
        let found = threads(bridge.pid()).into_iter().filter(move |(thread, _)| thread.starts_with(name));
        found.map(|(_, priority)| priority).collect::<Vec<_>>()
    };
    for name in ["ros-in", "ros-out", "ros-services"] {
        assert_eq!(of(name), [Some(42)], "{name}");
    }
    for name in ["ros-control", "ros-here", "ros-there"] {
        assert_eq!(of(name), [Some(40)], "{name}");
    }
    let mut rmw = threads(bridge.pid());
    rmw.retain(|(name, _)| is_rmws(name));
    assert!(rmw.len() >= 4 && rmw.iter().all(|(_, priority)| *priority == Some(41)), "{rmw:?}");
    assert_eq!(of("janitor"), [None]);
}

/// And its end gives their priority back.
#[test]
fn a_flood_from_ros_runs_without_priority() {
    let Some(venv) = ros() else { return };
    let Some(_) = test_needs(realtime_permitted(43)) else { return };
    let bridge = BridgeProcess::start_with(19, 19, &["--priority", "42", "--budget", "2"], |_| {});
    let participant = Participant::new(19).unwrap();
    let subscription = subscription(&participant, "/flood", STRING, Qos::keep_last(10));
    let mut peer = Peer::start(&venv, 19, "flood");
    let publisher = peer.publisher("/flood", STRING, json!({ "depth": 10 }));
    peer.matched(publisher, 1);
    let text = "x".repeat(100_000);
    let of_all = |is_wanted: &dyn Fn(&str, Option<u8>) -> bool| {
        let all = threads(bridge.pid());
        let mut watched = all
            .iter()
            .filter(|(name, _)| (name.starts_with("ros-") && name != "ros-budget") || is_rmws(name));
        watched.all(|(name, priority)| is_wanted(name, *priority))
    };
    wait_until("ordinary threads", || {
        peer.publish_text(publisher, &vec![&text; 50]);
        while subscription.try_take().unwrap().is_some() {}
        of_all(&|_, priority| priority.is_none())
    });
    bridge.wait_for("it to be told", |stats| stats["throttled"].as_u64() > Some(0));
    wait_until("their priority", || {
        of_all(&|name, priority| {
            let below = if is_rmws(name) {
                1
            } else {
                2 * u8::from(["ros-control", "ros-here", "ros-there"].contains(&name))
            };
            priority == Some(42 - below)
        })
    });
}

#[test]
fn a_bridge_in_another_program() {
    let Some(_) = ros() else { return };
    let options = Options { domain: 39, ros_domain: Some(40), realtime: Realtime::Off, ..Options::default() };
    reserve(options.domain);
    let bridge = Bridge::spawn(options.clone()).unwrap();
    let stats = bridge.stats();
    let rmw = std::env::var("RMW_IMPLEMENTATION").unwrap_or_else(|_| "rmw_fastrtps_cpp".to_owned());
    assert_eq!((stats.domain, stats.ros_domain, &stats.rmw), (39, 40, &rmw));
    let names: Vec<&str> = bridge.threads().iter().map(|thread| &*thread.name).collect();
    assert_eq!(names, ["ros-out", "ros-in", "ros-services", "ros-control", "ros-here", "ros-there"]);
    assert!(bridge.threads().iter().all(|thread| !matches!(thread.policy, Policy::Fifo(_))));
    drop(bridge);
    wait_until("its threads have ended", || {
        let threads = threads(std::process::id());
        // Fast DDS keeps one for the next participant.
        let is_left = |name: &str| name.starts_with("ros-") || is_rmws(name) && name != "dds.shm.wdog";
        !threads.iter().any(|(name, _)| is_left(name))
    });
    drop(Bridge::spawn(options).unwrap());
}
