// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic` on a type that `taut` was not built with.

use std::process::Command;
use tautline_schema::{DynamicMessage, Schema};
use tautline_transport::{Limits, Participant, Qos, TopicType};

const DOMAIN: u32 = 191;

fn taut(args: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    let output = command.args(args).env("TAUT_DOMAIN", DOMAIN.to_string()).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn topics_are_listed_and_echoed() {
    let name = "demo_msgs/msg/Echo".parse().unwrap();
    let schema = Schema::from_text(&name, "string word\nuint8[] numbers\n").unwrap();
    let hash = schema.hash().to_string();
    let topic_type =
        TopicType::new(name.to_string()).with_hash(hash.clone()).with_definition(schema.to_text());
    let participant = Participant::new(DOMAIN).unwrap();
    let qos = Qos::default().transient_local();
    let publisher = participant.create_raw_publisher("/echo", &topic_type, qos, Limits::default()).unwrap();
    let message =
        DynamicMessage::from_json(&schema.into(), r#"{"word": "taut", "numbers": [1, 2]}"#).unwrap();
    publisher.publish(&message.to_body()).unwrap();

    let list: serde_json::Value = serde_json::from_str(&taut(&["topic", "list", "--json"])).unwrap();
    let expected = serde_json::json!([{
        "topic": "/echo", "type": "demo_msgs/msg/Echo", "hash": hash, "publishers": 1, "subscriptions": 0,
        "remote_publishers": 0, "remote_subscriptions": 0, "places": [],
    }]);
    assert_eq!(list, expected);
    let table = taut(&["topic", "list"]);
    assert!(table.contains("/echo") && table.contains("demo_msgs/msg/Echo"), "{table}");
    assert_eq!(taut(&["topic", "echo", "/echo", "--once"]), "word: taut\nnumbers:\n- 1\n- 2\n---\n");
    let json = taut(&["topic", "echo", "echo", "--once", "--json"]);
    assert_eq!(json, "{\"word\":\"taut\",\"numbers\":[1,2]}\n");
}
