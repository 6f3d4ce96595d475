// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut component` without a container and with one that only answers; a real one is in node/components/container/tests.

mod support;

use futures::StreamExt;
use serde_json::json;
use std::process::Command;
use support::{Here, said};
use tautline::Qos;
use tautline::composition_interfaces::srv::{ListNodes, LoadNode, UnloadNode};

#[test]
fn a_container_that_is_not_there_is_named() {
    for arguments in [&["list"][..], &["unload", "7"], &["load", "libx.so:x::Y"]] {
        let mut taut = Command::new(env!("CARGO_BIN_EXE_taut"));
        taut.arg("component").args(arguments).args(["--container", "/nobody"]).env("TAUT_DOMAIN", "230");
        let output = taut.output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && text.contains("/nobody does not answer"), "{text}");
        assert!(text.contains("taut component run"), "{text}");
    }
}

#[test]
fn what_is_no_argument_is_refused_before_a_container_is_asked() {
    for (arguments, reason) in [
        (["-p", "gain=1"], "no name before ':='"),
        (["-p", ":=1"], "no name before ':='"),
        (["-p", "gain:=[1, x]"], "here are integer and string (x)"),
        (["-e", "use_intra_process_comms"], "no name before ':='"),
        (["--log-level", "loud"], "[possible values: debug, info, warn, error, fatal]"),
    ] {
        let mut taut = Command::new(env!("CARGO_BIN_EXE_taut"));
        let output = taut.args(["component", "load", "libx.so:x::Y"]).args(arguments).output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && text.contains(reason), "{arguments:?}: {text}");
    }
}

/// What a container answers is printed, also as JSON; `run`, which starts a program that has options of its own, refuses the option.
#[test]
fn answers_of_a_container_are_printed() {
    let mut here = Here::new(58);
    let mut manager = here.node("ComponentManager", "");
    let qos = Qos::services_default();
    macro_rules! answer {
        ($service:ident, $verb:literal, $response:expr) => {
            let name = concat!("/ComponentManager/_container/", $verb);
            let requests = manager.create_service::<$service::Service>(name, qos).unwrap().owned();
            let answer = requests.for_each(|request| {
                let response = $response(&request.message);
                request.respond(response).unwrap();
                std::future::ready(())
            });
            here.serve(&mut manager, answer);
        };
    }
    answer!(LoadNode, "load_node", |_: &LoadNode::Request| LoadNode::Response {
        success: true,
        full_node_name: "/counter".to_owned(),
        unique_id: 2,
        ..Default::default()
    });
    answer!(ListNodes, "list_nodes", |_: &ListNodes::Request| ListNodes::Response {
        full_node_names: vec!["/counter".to_owned()],
        unique_ids: vec![2],
    });
    answer!(UnloadNode, "unload_node", |request: &UnloadNode::Request| UnloadNode::Response {
        success: request.unique_id == 2,
        error_message: "no such number".to_owned(),
    });
    for verb in [&["component", "load", "libx.so"][..], &["component", "list"]] {
        assert_eq!(here.taut(verb), "2 /counter\n");
        assert_eq!(here.json(verb), json!([{ "id": 2, "node": "/counter" }]));
    }
    assert_eq!(here.taut(&["component", "unload", "2"]), "");
    assert_eq!(here.json(&["component", "unload", "2"]), json!([{ "id": 2 }]));
    said(&here.refused(&["component", "unload", "3", "--json"]), 1, "no such number");
    let refused =
        Command::new(env!("CARGO_BIN_EXE_taut")).args(["component", "--json", "run"]).output().unwrap();
    let words = String::from_utf8(refused.stderr).unwrap();
    assert!(refused.status.code() == Some(2) && words.contains("starts a container"), "{words}");
}
