// SPDX-License-Identifier: MIT OR Apache-2.0
//! Components in a container, and libraries that it refuses.

use futures::StreamExt;
use futures::executor::block_on;
use std::future::ready;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use tautline::composition_interfaces::srv::{ListNodes, LoadNode, UnloadNode};
use tautline::rcl_interfaces::msg::{Log, Parameter};
use tautline::std_msgs::msg::UInt64;
use tautline::{Context, Node, ParameterValue, Qos, Realtime};
use tautline_components::{ComponentError, Container, Load, STAMP};

const CONTAINER: &str = env!("CARGO_BIN_EXE_taut-container");

/// Built with the container, of which it shares the features: the test depends on it.
fn demo() -> PathBuf {
    Path::new(CONTAINER).with_file_name("deps").join("libtautline_demo_components.so")
}

fn container(domain: u32, loads: &[String]) -> Command {
    let mut command = Command::new(CONTAINER);
    command.arg("--no-rt").args(loads).env("TAUT_DOMAIN", domain.to_string());
    // It finds its libraries by itself.
    command.env_remove("LD_LIBRARY_PATH");
    command
}

/// What the container says of what it does not load.
fn refused(loads: &[String]) -> String {
    let Output { status, stderr, .. } = container(59, loads).output().unwrap();
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(2), "{said}");
    said
}

/// A parameter, or an extra argument.
type Named = (&'static str, ParameterValue);

struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn components_of_one_process_work_together_until_it_ends() {
    let context = Context::builder().domain(59).realtime(Realtime::Off).build().unwrap();
    let mut node = Node::create(context.clone(), "test", "").unwrap();
    let doubled = node.subscribe::<UInt64>("/robot/doubled", Qos::default()).unwrap();
    let spinning = std::thread::spawn(move || context.spin().map(|()| context));
    let library = demo();
    let loads =
        ["demo::Counter", "demo::Doubler"].map(|component| format!("{}:{component}", library.display()));
    // One of them behind ROS 2's arguments.
    let mut command = container(59, &loads[..1]);
    command.args(["--namespace", "/robot", "--ros-args", "-p", "/robot/counter:step:=4", "--", &loads[1]]);
    command.stdout(Stdio::piped());
    let mut running = Running(command.spawn().unwrap());
    let lines = BufReader::new(running.0.stdout.take().unwrap()).lines().take(2).map(Result::unwrap);
    assert_eq!(lines.collect::<Vec<_>>(), ["1 /robot/counter", "2 /robot/doubler"]);
    let values: Vec<u64> = block_on(doubled.take(5).map(|message| message.data).collect());
    assert!(values.iter().all(|value| value % 8 == 0) && values.is_sorted(), "{values:?}");
    let pid = rustix::process::Pid::from_child(&running.0);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    assert!(running.0.wait().unwrap().success());
    node.context().shutdown();
    drop(spinning.join().unwrap().unwrap());
}

#[test]
fn components_run_on_when_nobody_reads_their_names() {
    let context = Context::builder().domain(59).realtime(Realtime::Off).build().unwrap();
    let mut node = Node::create(context.clone(), "test", "").unwrap();
    let counts = node.subscribe::<UInt64>("/unread/count", Qos::default()).unwrap();
    let spinning = std::thread::spawn(move || context.spin().map(|()| context));
    let (reader, closed) = std::io::pipe().unwrap();
    drop(reader);
    let mut command = container(59, &[format!("{}:demo::Counter", demo().display())]);
    let running = Running(command.args(["--namespace", "/unread"]).stdout(closed).spawn().unwrap());
    assert_eq!(block_on(counts.take(2).count()), 2);
    drop(running);
    node.context().shutdown();
    drop(spinning.join().unwrap().unwrap());
}

#[test]
fn a_library_of_another_build_is_refused_with_both_builds() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(demo()).unwrap();
    let own = String::from_utf8_lossy(&STAMP).into_owned();
    let at = bytes.windows(STAMP.len()).position(|window| *window == STAMP).unwrap();
    for (from, to) in [("rustc 1.", "rustc 0."), ("Tautline 0.", "Tautline 9."), ("linux", "minix")] {
        let mut other = bytes.clone();
        let place = at + own.find(from).unwrap();
        other[place..place + from.len()].copy_from_slice(to.as_bytes());
        let path = folder.path().join("libother.so");
        std::fs::write(&path, other).unwrap();
        let text = refused(&[format!("{}:demo::Counter", path.display())]);
        assert!(
            text.contains(from) && text.contains(to) && text.contains("same compiler and Tautline"),
            "{text}"
        );
    }
}

#[test]
fn what_has_no_entry_point_or_is_no_library_is_refused() {
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    let libc =
        maps.lines().find_map(|line| line.split_whitespace().nth(5).filter(|path| path.contains("libc.so")));
    let text = refused(&[libc.unwrap().to_owned()]);
    assert!(text.contains("no entry point for components") && text.contains("components!"), "{text}");
    let text = refused(&["/proc/self/status".to_owned()]);
    assert!(text.contains("is not a shared library"), "{text}");
    let text = refused(&["/nowhere/libx.so".to_owned()]);
    assert!(text.contains("/nowhere/libx.so cannot be read"), "{text}");
    // What a ROS 2 user types.
    let text = refused(&["demo_nodes_cpp:demo_nodes_cpp::Talker".to_owned()]);
    assert!(text.contains("is the path of a file here"), "{text}");
    let text = refused(&["/dev/zero".to_owned()]);
    assert!(text.contains("not a regular file"), "{text}");
    let text = refused(&["--ros-args", "--", "--name", "x"].map(str::to_owned));
    assert!(text.contains("--name stands behind --ros-args"), "{text}");
}

#[test]
fn unknown_and_broken_components_are_named() {
    let library = demo();
    let load = |component: &str| refused(&[format!("{}{component}", library.display())]);
    let known = "demo::Counter, demo::Doubler, demo::Broken, demo::Unfinished";
    assert!(load(":demo::Counter2").contains(&format!("no component 'demo::Counter2'; it has: {known}")));
    assert!(load("").contains(known), "it has several");
    let text = load(":demo::Broken");
    assert!(text.contains("component 'demo::Broken' panicked while it was created"), "{text}");
}

/// This test has a Tautline of its own in it, as every ordinary program.
#[test]
fn a_process_that_does_not_share_its_tautline_systems_nothing() {
    let context = Context::builder().domain(59).realtime(Realtime::Off).build().unwrap();
    let mut container = Container::new(context);
    let load = Load { library: demo(), component: "demo::Counter".into(), ..Load::default() };
    match container.load(&load).unwrap_err() {
        // As far as it comes without the library's folder in LD_LIBRARY_PATH.
        ComponentError::OtherCopy { .. } | ComponentError::Load { .. } => {}
        other => panic!("{other}"),
    }
    assert_eq!(container.list().count(), 0);
    assert!(matches!(container.unload(1), Err(ComponentError::NoSuchId { id: 1 })));
}

#[test]
fn components_come_and_go_by_service() {
    let context = Context::builder().domain(59).realtime(Realtime::Off).build().unwrap();
    let mut node = Node::create(context.clone(), "manager", "").unwrap();
    let [load, unload, list] = ["load", "unload", "list"]
        .map(|verb| format!("/served/_container/{verb}_node").replace("list_node", "list_nodes"));
    let load = node.create_client::<LoadNode::Service>(&load).unwrap();
    let unload = node.create_client::<UnloadNode::Service>(&unload).unwrap();
    let list = node.create_client::<ListNodes::Service>(&list).unwrap();
    let counts = node.subscribe::<UInt64>("/moved/count", Qos::default()).unwrap();
    let global = node.subscribe::<UInt64>("/global/count", Qos::default()).unwrap();
    let lines = node.subscribe::<Log>("/rosout", Qos::default().transient_local()).unwrap().owned();
    let spinning = std::thread::spawn(move || context.spin().map(|()| context));

    let mut command = container(59, &[]);
    let command = command.args(["--name", "served", "--ros-args", "-r", "count:=/global/count"]);
    let running = Running(command.spawn().unwrap());
    block_on(list.wait_for_service().unwrap()).unwrap();
    let ask_with = |plugin: &str, rules: &[&str], level: u8, parameters: &[Named], extra: &[Named]| {
        let message = |(name, value): &Named| Parameter { name: (*name).into(), value: value.into() };
        let request = LoadNode::Request {
            package_name: demo().to_str().unwrap().into(),
            plugin_name: plugin.into(),
            node_name: "mine".into(),
            node_namespace: "/robot".into(),
            remap_rules: rules.iter().map(|rule| (*rule).into()).collect(),
            log_level: level,
            parameters: parameters.iter().map(message).collect(),
            extra_arguments: extra.iter().map(message).collect(),
        };
        block_on(load.request(&request).unwrap()).unwrap()
    };
    let ask = |plugin: &str, rules: &[&str], level: u8| ask_with(plugin, rules, level, &[], &[]);
    let names = || block_on(list.request(&Default::default()).unwrap()).unwrap().full_node_names;
    let end = |unique_id| block_on(unload.request(&UnloadNode::Request { unique_id }).unwrap()).unwrap();

    assert!(names().is_empty());
    let loaded = ask("demo::Counter", &["count:=/moved/count"], 0);
    assert_eq!((loaded.success, &*loaded.full_node_name, loaded.unique_id), (true, "/robot/mine", 1));
    assert_eq!(names(), ["/robot/mine"]);
    let values: Vec<u64> = block_on(counts.take(3).map(|message| message.data).collect());
    assert!(values.is_sorted());
    let with = |parameters: &[Named], extra: &[Named]| ask_with("demo::Counter", &[], 0, parameters, extra);
    for (refused, reason) in [
        (ask("demo::Nothing", &[], 0), "no component 'demo::Nothing'"),
        (ask("demo::Broken", &[], 0), "panicked"),
        (ask("demo::Counter", &["no rule"], 0), "no rule"),
        (ask("demo::Counter", &[], 11), "log level 11 is none"),
        (
            ask("demo::Unfinished", &["count:=/unfinished/count"], 0),
            "component 'demo::Unfinished' was not created",
        ),
        (
            with(&[("step", "fast".into())], &[]),
            "parameter 'step' is of type integer, but fast is of type string",
        ),
        (with(&[], &[("speed", 1.into())]), "extra argument 'speed' is not known"),
        (with(&[], &[("forward_global_arguments", 1.into())]), "is true or false, not 1"),
    ] {
        assert!(!refused.success && refused.error_message.contains(reason), "{}", refused.error_message);
    }
    assert_eq!(names(), ["/robot/mine"], "what is refused changes nothing");
    assert_eq!(node.count_publishers("/unfinished/count").unwrap(), 0, "what had been started has ended");
    assert!(end(1).success);
    assert!(names().is_empty());
    let again = end(1);
    assert!(
        !again.success && again.error_message.contains("no component has number 1"),
        "{}",
        again.error_message
    );
    // A parameter, a level, and what the container's own command line says.
    let forwarded = [("forward_global_arguments", true.into()), ("use_intra_process_comms", true.into())];
    let loaded = ask_with("demo::Counter", &[], 10, &[("step", 1000.into())], &forwarded);
    assert_eq!((loaded.success, loaded.unique_id), (true, 2), "{}", loaded.error_message);
    assert!(
        block_on(global.take(2).map(|count| count.data % 1000).collect::<Vec<_>>())
            .iter()
            .all(|rest| *rest == 0)
    );
    let line = block_on(lines.filter(|line| ready(line.level == 10)).next()).unwrap();
    assert_eq!((&*line.name, &*line.msg), ("robot.mine", "counts in steps of 1000"));
    drop(running);
    node.context().shutdown();
    drop(spinning.join().unwrap().unwrap());
}

#[test]
fn a_library_that_was_replaced_is_not_taken_for_the_one_that_is_loaded() {
    let folder = tempfile::tempdir().unwrap();
    let library = folder.path().join("libmine.so");
    std::fs::copy(demo(), &library).unwrap();
    let context = Context::builder().domain(76).realtime(Realtime::Off).build().unwrap();
    let mut node = Node::create(context.clone(), "manager", "").unwrap();
    let load = node.create_client::<LoadNode::Service>("/ComponentManager/_container/load_node").unwrap();
    let spinning = std::thread::spawn(move || context.spin().map(|()| context));
    let running = Running(container(76, &[]).spawn().unwrap());
    block_on(load.wait_for_service().unwrap()).unwrap();
    let ask = || {
        let plugin_name = "demo::Counter".into();
        let package_name = library.to_str().unwrap().into();
        let request = LoadNode::Request { package_name, plugin_name, ..Default::default() };
        block_on(load.request(&request).unwrap()).unwrap()
    };
    // Two of one name: each has its number.
    let loaded = [ask(), ask()].map(|loaded| (loaded.success, loaded.unique_id, loaded.full_node_name));
    assert_eq!(loaded, [(true, 1, "/counter".to_owned()), (true, 2, "/counter".to_owned())]);
    let next = folder.path().join("next.so");
    std::fs::copy(demo(), &next).unwrap();
    std::fs::rename(next, &library).unwrap();
    let refused = ask();
    assert!(
        !refused.success && refused.error_message.contains("was replaced since it was loaded"),
        "{}",
        refused.error_message
    );
    std::fs::remove_file(&library).unwrap();
    assert!(ask().error_message.contains("cannot be read"));
    drop(running);
    node.context().shutdown();
    drop(spinning.join().unwrap().unwrap());
}
