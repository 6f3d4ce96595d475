// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random messages of every type of a real ROS 2: rclpy's bytes hold the same values here, ours the same values there.

#[path = "support/peer.rs"]
mod peer;
mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use peer::{Peer, hex};
use tautline_schema::{DynamicMessage, Kind, Layout, Packages, Schema, Size, TypeName};

/// Messages per type.
const COUNT: usize = 100;

#[test]
fn values_are_the_same_on_both_sides() {
    let Some(venv) = support::ros() else { return };
    let seed = tautline_seed::seed();
    let mut packages = support::packages(&venv);
    let mut peer = Peer::start(&venv);
    let (mut types, mut messages, mut bytes) = (0, 0, 0);
    let mut trailing = BTreeMap::<usize, usize>::new();
    for name in messages_of(&mut packages) {
        let schema = Arc::new(packages.schema(&name).unwrap());
        let fixed = match Layout::of(&schema).size {
            Size::Fixed(size) => Some(size),
            Size::Formula(_) => None,
        };
        let mut answers = String::new();
        for (index, (cdr, json)) in peer.messages(&name, COUNT, seed).iter().enumerate() {
            let decoded = compare(&schema, cdr, json);
            // Reading YAML is what takes most of the time there.
            let yaml = if index % 10 == 0 { decoded.to_string() } else { String::new() };
            let yaml = serde_json::to_string(&yaml).unwrap();
            answers.push_str(&format!("{} {yaml}\n", hex(&decoded.to_cdr())));
            assert!(fixed.is_none_or(|size| size == decoded.to_body().len()), "{name}: {fixed:?}");
            *trailing.entry(decoded.trailing_bytes()).or_default() += 1;
            messages += 1;
            bytes += cdr.len();
        }
        assert_eq!(peer.answer(&answers), "ok", "{name}");
        types += 1;
    }
    println!(
        "{types} types, {messages} messages, {bytes} bytes each way; messages by trailing bytes: {trailing:?}"
    );
    assert!(types >= 250, "{types}");
}

/// Decodes what rclpy wrote, holds it against what rclpy says it is, and sends it through every form.
fn compare(schema: &Arc<Schema>, cdr: &[u8], json: &str) -> DynamicMessage {
    let name = schema.name();
    let decoded = DynamicMessage::from_cdr(schema, cdr).unwrap_or_else(|error| panic!("{error}: {json}"));
    let said = DynamicMessage::from_json(schema, json).unwrap_or_else(|error| panic!("{error}: {json}"));
    // As text: NaN equals itself, 0.0 does not equal -0.0.
    let text = decoded.to_json();
    assert_eq!(text, said.to_json(), "{name}");
    let bytes = decoded.to_cdr();
    assert_eq!(bytes, said.to_cdr(), "{name}: the same value has the same bytes");
    let again = DynamicMessage::from_cdr(schema, &bytes).unwrap();
    assert_eq!((again.to_json(), again.trailing_bytes()), (text.clone(), 0), "{name}");
    let yaml = decoded.to_string();
    let from_yaml =
        DynamicMessage::from_yaml(schema, &yaml).unwrap_or_else(|error| panic!("{error}: {yaml}"));
    assert_eq!(from_yaml.to_json(), text, "{name}: {yaml}");
    decoded
}

/// All messages, and those that services and actions consist of.
fn messages_of(packages: &mut Packages) -> BTreeSet<TypeName> {
    let mut names = BTreeSet::new();
    for name in packages.list() {
        let schema = packages.schema(&name).unwrap();
        if name.kind() == Kind::Msg {
            names.insert(name);
        } else {
            let derived = schema.referenced().map(|definition| &definition.name);
            // The services of an action are no messages.
            names.extend(derived.filter(|name| !name.name().ends_with("_SendGoal")).cloned());
        }
    }
    names.retain(|name| !name.name().ends_with("_GetResult"));
    names
}
