// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut service`: requests written by hand, and servers that answer, are silent, or die.

mod support;

use futures::{FutureExt, StreamExt};
use serde_json::json;
use support::{Here, said};
use tautline::Qos;
use tautline::std_srvs::srv::{SetBool, Trigger};

#[test]
fn services_are_found_and_asked() {
    let mut here = Here::new(83);
    let mut node = here.node("lights", "/robot");
    let qos = Qos::services_default();
    let requests = node.create_service::<SetBool::Service>("/robot/lights", qos).unwrap().owned();
    let answer = requests.for_each(|request| {
        let is_on = request.message.data;
        let message = if is_on { "on: all" } else { "off" }.to_owned();
        request.respond(SetBool::Response { success: is_on, message }).unwrap();
        std::future::ready(())
    });
    here.serve(&mut node, answer);
    let _silent = node.create_service::<Trigger::Service>("/silent", qos).unwrap();
    let requests = node.create_service::<Trigger::Service>("/dying", qos).unwrap().owned();
    // With its first request in hand.
    here.serve(&mut node, requests.into_future().map(drop));
    let _client = node.create_client::<Trigger::Service>("/unserved").unwrap();

    assert_eq!(here.taut(&["service", "type", "robot/lights"]), "std_srvs/srv/SetBool\n");
    assert_eq!(here.json(&["service", "type", "/silent"]), json!(["std_srvs/srv/Trigger"]));
    assert_eq!(here.taut(&["service", "find", "std_srvs/SetBool"]), "/robot/lights\n");
    let on = "success: true\nmessage: 'on: all'\n";
    for args in [
        &["service", "call", "/robot/lights", "{data: true}"][..],
        &["service", "call", "robot/lights", "std_srvs/srv/SetBool", "{\"data\": true}"],
        &["service", "call", "/robot/lights", "std_srvs/SetBool", "data: true", "--timeout", "100s"],
    ] {
        assert_eq!(here.taut(args), on, "{args:?}");
    }
    let off = here.json(&["service", "call", "/robot/lights", "std_srvs/srv/SetBool"]);
    assert_eq!(off, json!({ "success": false, "message": "off" }));

    let call = |args: &[&str]| here.refused(&[&["service", "call"], args].concat());
    said(
        &call(&["/robot/light"]),
        1,
        "no service '/robot/light'; did you mean /robot/lights? `taut service list`",
    );
    said(&call(&["/unserved"]), 1, "'/unserved' has clients, but no server");
    said(&call(&["/silent", "--timeout", "50ms"]), 1, "waited for '/silent' to answer for 50ms and gave up");
    said(&call(&["/dying"]), 1, "'/dying': its server ended without a response");
    said(
        &call(&["/robot/lights", "std_srvs/srv/Trigger"]),
        2,
        "is of type std_srvs/srv/SetBool, not std_srvs",
    );
    said(&call(&["/robot/lights", "{date: true}"]), 2, "there is no field `date`");
    said(&call(&["/robot/lights", "{data: maybe}"]), 2, "data");
    said(&call(&["/robot/lights", "{data"]), 2, "unclosed bracket");
    said(&here.refused(&["service", "type", "/silence"]), 1, "did you mean /silent?");
    said(&here.refused(&["service", "find", "std_srvs/Triger"]), 1, "did you mean std_srvs/srv/Trigger?");

    // What waits says so, and ends when it is told to.
    let mut waiting = here.start(&["service", "call", "/silent"]);
    assert_eq!(waiting.words(), "taut: waiting for '/silent' to answer ...\n");
    waiting.interrupt();
    assert_eq!(waiting.end().0, 1);
}
