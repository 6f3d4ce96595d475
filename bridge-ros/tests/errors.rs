// SPDX-License-Identifier: MIT OR Apache-2.0
//! What goes wrong is said with its fix, and the rest of the bridge goes on.

mod support;

use serde_json::json;
use std::fs;
use std::path::Path;
use std::process::Command;
use support::{BridgeProcess, Peer, STRING, failure_of, matched, publisher, ros, text_body, wait_until};
use tautline_transport::{Limits, Participant, Qos, TopicType};

/// A prefix with a package of which only the definitions are installed, before those of ROS 2.
fn with_half_a_package(folder: &Path) -> String {
    let share = folder.join("share/half_msgs/msg");
    fs::create_dir_all(&share).unwrap();
    fs::write(share.join("Half.msg"), "uint8 x\n").unwrap();
    let rest = std::env::var("AMENT_PREFIX_PATH").unwrap_or_default();
    format!("{}:{rest}", folder.display())
}

#[test]
fn types_that_ros_does_not_have_are_named_and_the_rest_goes_on() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 4;
    let folder = tempfile::tempdir().unwrap();
    let path = with_half_a_package(folder.path());
    let bridge = BridgeProcess::start_with(DOMAIN, DOMAIN, &[], |command| {
        command.arg("--no-rt").env("AMENT_PREFIX_PATH", path);
    });
    let participant = Participant::new(DOMAIN).unwrap();
    let other_hash = TopicType::new(STRING).with_hash(format!("RIHS01_{}", "1".repeat(64)));
    let limits = Limits::default();
    let _changed = participant.create_raw_publisher("/changed", &other_hash, Qos::default(), limits).unwrap();
    let _ends = [
        ("/no_package", "no_such_msgs/msg/Thing"),
        ("/no_library", "half_msgs/msg/Half"),
        ("/no_type", "std_msgs/msg/Sting"),
        ("/no_name", "Float"),
    ]
    .map(|(topic, type_name)| publisher(&participant, topic, type_name, Qos::default()));
    let expected = [
        ("/no_package", "ros-$ROS_DISTRO-no-such-msgs"),
        ("/no_library", "rosidl_default_generators"),
        ("/no_type", "has no msg 'Sting'"),
        ("/no_name", "write package/msg/Name"),
        ("/changed", "another definition"),
    ];
    for (topic, part) in expected {
        bridge.wait_for(topic, |stats| {
            stats["not_bridged"][topic].as_str().is_some_and(|said| said.contains(part))
        });
        wait_until("it is said", || bridge.said().contains(&format!("'{topic}' is not bridged")));
    }
    let mut peer = Peer::start(&venv, DOMAIN, "fine");
    let here = publisher(&participant, "/fine", STRING, Qos::default());
    let there = peer.subscription("/fine", STRING, json!({}));
    matched(&here, 1);
    here.publish(&text_body("fine")).unwrap();
    assert_eq!(peer.take_texts(there, 1), ["fine"]);
    // Once, though it is tried again.
    let said = bridge.said();
    assert_eq!(said.matches("'/no_package' is not bridged").count(), 1, "{said}");
}

#[test]
fn what_cannot_run_says_what_to_do() {
    if ros().is_none() {
        return;
    }
    // ROS ends the process before it begins; `taut bridge-ros` says the fix.
    let options = ["--domain", "5", "--ros-domain", "5", "--no-rt"];
    let said = failure_of(&options, |command| {
        command.env("RMW_IMPLEMENTATION", "rmw_nowhere_cpp");
    });
    assert!(said.contains("rmw_nowhere_cpp") && said.contains("rmw_fastrtps_cpp"), "{said}");

    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bridge.toml");
    fs::write(&file, "colour = 1\n[[topic]]\ntopic = 'x'\n").unwrap();
    let said = failure_of(&["--config", file.to_str().unwrap()], |_| {});
    assert!(said.contains("bridge.toml has 2 problem(s)"), "{said}");
    assert!(
        said.contains("line 1: the file has no `colour`") && said.contains("line 3: `topic`: 'x'"),
        "{said}"
    );
    let said = failure_of(&["--config", "/no/such.toml"], |_| {});
    assert!(said.contains("/no/such.toml cannot be read"), "{said}");
    let said = failure_of(&["--no-rt"], |command| {
        command.env("TAUT_DOMAIN", "x");
    });
    assert!(said.contains("TAUT_DOMAIN=x"), "{said}");
}

#[test]
fn help_has_examples() {
    let said = Command::new(env!("CARGO_BIN_EXE_taut-bridge-ros")).arg("--help").output().unwrap();
    let help = String::from_utf8(said.stdout).unwrap();
    assert!(said.status.success() && help.contains("Examples:"), "{help}");
}
