// SPDX-License-Identifier: MIT OR Apache-2.0
//! What goes wrong is said with its fix, and the rest of the bridge goes on.

mod support;

use rustix::fs::OFlags;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use support::{
    BridgeProcess, Peer, STRING, built, failure, failure_of, matched, publisher, reserve, ros, scope,
    text_body, wait_until,
};
use tautline_transport::{Limits, Participant, Qos, TopicType};

const BRIDGE: &str = env!("CARGO_BIN_EXE_taut-bridge-ros");
/// As in `/proc/PID/syscall`.
const SYS_WRITE: &str = if cfg!(target_arch = "x86_64") { "1" } else { "64" };

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
        ("/changed", "differs from the topic"),
    ];
    for (topic, part) in expected {
        bridge.wait_for(topic, |stats| {
            stats["not_bridged"][topic].as_str().is_some_and(|said| said.contains(part))
        });
        wait_until("it is said", || bridge.said().contains(&format!("'{topic}' is not mirrored")));
    }
    let mut peer = Peer::start(&venv, DOMAIN, "fine");
    let here = publisher(&participant, "/fine", STRING, Qos::default());
    let there = peer.subscription("/fine", STRING, json!({}));
    matched(&here, 1);
    here.publish(&text_body("fine")).unwrap();
    assert_eq!(peer.take_texts(there, 1), ["fine"]);
    // Once, though it is tried again.
    let said = bridge.said();
    assert_eq!(said.matches("'/no_package' is not mirrored").count(), 1, "{said}");
}

#[test]
fn what_cannot_run_says_what_to_do() {
    let Some(_) = ros() else { return };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bridge.toml");
    fs::write(&file, "colour = 1\n[[topic]]\ntopic = 'x'\n").unwrap();
    let said = failure_of(&["--config", file.to_str().unwrap()], |_| {});
    assert!(said.contains("bridge.toml has 2 problem(s)"), "{said}");
    assert!(
        said.contains("1:1: unknown key `colour` in the file") && said.contains("3:9: `topic`: 'x'"),
        "{said}"
    );
    let said = failure_of(&["--config", "/no/such.toml"], |_| {});
    assert!(said.contains("/no/such.toml cannot be read"), "{said}");
    let said = failure_of(&["--no-rt"], |command| {
        command.env("TAUT_DOMAIN", "x");
    });
    assert!(said.contains("TAUT_DOMAIN=x"), "{said}");
}

/// What `taut bridge-ros` says of a bridge that cannot run.
fn taut_says(taut: &Path, change: impl FnOnce(&mut Command)) -> String {
    let mut command = Command::new(taut);
    command.args(["bridge-ros", "--domain", "16", "--ros-domain", "16", "--no-rt"]).env_remove("RUST_LOG");
    reserve(16);
    change(command.env("TAUT_SCOPE", scope()));
    failure(command)
}

#[test]
fn another_rmw_is_told_by_taut_with_the_fix() {
    let (Some(_), Some(taut)) = (ros(), built("taut", "taut")) else { return };
    let said = taut_says(&taut, |command| {
        command.env("RMW_IMPLEMENTATION", "rmw_nowhere_cpp");
    });
    for part in [
        "ROS 2 does not start with RMW_IMPLEMENTATION=rmw_nowhere_cpp",
        "unset it, or install that one (apt install ros-$ROS_DISTRO-rmw-nowhere-cpp) and source ROS 2 again",
    ] {
        assert!(said.contains(part), "{said}");
    }
}

/// The program without the path at which it finds ROS 2: it is overwritten where the linker put it, with one as long that leads
/// nowhere.
fn without_rpath(program: Vec<u8>) -> Vec<u8> {
    let Some(rpath) = option_env!("TAUT_ROS_RPATH") else { return program };
    let nowhere: Vec<u8> = b"/nowhere".iter().copied().cycle().take(rpath.len()).collect();
    let mut program = program;
    let mut at = 0;
    while let Some(found) = program[at..].windows(rpath.len()).position(|part| part == rpath.as_bytes()) {
        program[at + found..][..rpath.len()].copy_from_slice(&nowhere);
        at += found + rpath.len();
    }
    assert!(at > 0, "no {rpath} in the program");
    program
}

#[test]
fn missing_libraries_are_told_by_taut_with_the_fix() {
    let (Some(_), Some(taut)) = (ros(), built("taut", "taut")) else { return };
    let folder = tempfile::tempdir().unwrap();
    let [beside, bridge] = ["taut", "taut-bridge-ros"].map(|name| folder.path().join(name));
    fs::copy(taut, &beside).unwrap();
    // For its mode.
    fs::copy(BRIDGE, &bridge).unwrap();
    fs::write(&bridge, without_rpath(fs::read(BRIDGE).unwrap())).unwrap();
    let said = taut_says(&beside, |command| {
        command.env_remove("LD_LIBRARY_PATH");
    });
    for part in [
        "taut-bridge-ros does not find the libraries of ROS 2",
        "error while loading shared libraries",
        "source the ROS 2 that it was built with (source /opt/ros/jazzy/setup.bash), and run it again",
    ] {
        assert!(said.contains(part), "{said}");
    }
}

#[test]
fn a_second_signal_does_not_wait_for_the_end() {
    let Some(_) = ros() else { return };
    // Whoever should read its numbers does not, and nothing more fits: it cannot end in order.
    let (output, mut input) = std::io::pipe().unwrap();
    rustix::fs::fcntl_setfl(&input, OFlags::NONBLOCK).unwrap();
    while input.write(&[b'\n'; 512]).is_ok() {}
    while input.write(b"\n").is_ok() {}
    rustix::fs::fcntl_setfl(&input, OFlags::empty()).unwrap();
    let mut command = BridgeProcess::command(38, 38, &["--no-rt"], |_| {});
    let mut bridge = command.stdout(input).spawn().unwrap();
    // The builder has the other end of the pipe.
    drop(command);
    let pid = Pid::from_child(&bridge);
    let is_writing = || {
        let call = fs::read_to_string(format!("/proc/{}/syscall", bridge.id())).unwrap();
        // Its number and the first argument, which is the descriptor of standard output.
        call.split_whitespace().take(2).eq([SYS_WRITE, "0x1"])
    };
    wait_until("it waits for the reader", is_writing);
    kill_process(pid, Signal::INT).unwrap();
    let has_come = || {
        let status = fs::read_to_string(format!("/proc/{}/status", bridge.id())).unwrap();
        status
            .lines()
            .any(|line| line.starts_with("ShdPnd:") && line.trim_end().ends_with("\t0000000000000000"))
    };
    wait_until("the first signal has come", has_come);
    wait_until("it still waits for the reader", is_writing);
    assert_eq!(bridge.try_wait().unwrap(), None);
    // Those that come at once with the first are the same stop.
    let mut status = None;
    wait_until("its end", || {
        kill_process(pid, Signal::TERM).unwrap();
        status = bridge.try_wait().unwrap();
        status.is_some()
    });
    assert_eq!(status.unwrap().code(), Some(128 + 15));
    drop(output);
    // The next one in the domain removes what it left there.
    drop(Participant::new(38).unwrap());
    let lock = format!("/dev/shm/{}/bridge_ros_38", tautline_rt::domain::shared_folder(38));
    assert!(!Path::new(&lock).exists());
}

#[test]
fn it_bridges_on_when_nobody_reads_what_it_says() {
    let Some(_) = ros() else { return };
    let (reader, closed) = std::io::pipe().unwrap();
    drop(reader);
    let mut command = BridgeProcess::command(46, 46, &["--no-rt"], |_| {});
    let mut bridge = command.stdout(Stdio::piped()).stderr(closed).spawn().unwrap();
    let lines = BufReader::new(bridge.stdout.take().unwrap()).lines();
    let mut numbers = lines.map(|line| serde_json::from_str::<Value>(&line.unwrap()).unwrap());
    let participant = Participant::new(46).unwrap();
    // The thread that warns of the first one also finds the second.
    for topic in ["/first", "/second"] {
        let _publisher = publisher(&participant, topic, "no_such_msgs/msg/Thing", Qos::default());
        let is_told = |numbers: Value| numbers["not_bridged"][topic].is_string();
        assert!(numbers.by_ref().take(1200).any(is_told), "{topic}");
    }
    kill_process(Pid::from_child(&bridge), Signal::TERM).unwrap();
    assert!(bridge.wait().unwrap().success());
}

#[test]
fn it_bridges_on_when_its_numbers_cannot_be_written() {
    let Some(_) = ros() else { return };
    const FULL: &str = "No space left on device";
    let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut command = BridgeProcess::command(47, 47, &["--no-rt"], |_| {});
    let mut bridge = command.stdout(full).stderr(Stdio::piped()).spawn().unwrap();
    let mut times_said = 0;
    let lines = BufReader::new(bridge.stderr.take().unwrap()).lines().map_while(Result::ok);
    let mut lines = lines.inspect(|line| times_said += usize::from(line.contains(FULL)));
    assert!(lines.any(|line| line.contains(FULL)));
    let participant = Participant::new(47).unwrap();
    let _publisher = publisher(&participant, "/x", "no_such_msgs/msg/Thing", Qos::default());
    assert!(lines.any(|line| line.contains("'/x' is not mirrored")), "it has ended");
    kill_process(Pid::from_child(&bridge), Signal::TERM).unwrap();
    lines.for_each(drop);
    assert!(bridge.wait().unwrap().success());
    assert_eq!(times_said, 1);
}

#[test]
fn help_has_examples() {
    let said = Command::new(BRIDGE).arg("--help").output().unwrap();
    let help = String::from_utf8(said.stdout).unwrap();
    assert!(said.status.success() && help.contains("Examples:"), "{help}");
}
