// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random messages of every generated type that a real ROS 2 has: rclpy's bytes decode into the owned struct, its bytes
//! are those of the dynamic message, and rclpy reads the same values from them.

use std::collections::BTreeSet;

use tautline_schema::{DynamicMessage, Kind, Packages};

use crate::entry::entries;
use crate::peer::{Peer, hex};
use crate::support;

/// Messages per type.
const COUNT: usize = 100;

#[test]
fn values_are_the_same_on_both_sides() {
    let Some(venv) = support::ros() else { return };
    let seed = tautline_seed::seed();
    let mut packages = support::packages(&venv);
    let theirs: BTreeSet<_> = packages.list().iter().map(|name| name.package().to_owned()).collect();
    let mut peer = Peer::start(&venv);
    let (mut types, mut messages, mut bytes) = (0, 0, 0);
    for entry in entries() {
        let name = entry.type_name();
        if !theirs.contains(name.package()) {
            continue;
        }
        let schema = std::sync::Arc::new(packages.schema(&name).unwrap());
        assert_eq!(schema.hash().to_string(), entry.hash, "{name}");
        let mut answers = String::new();
        for (cdr, json) in peer.messages(&name, COUNT, seed) {
            let dynamic = DynamicMessage::from_json(&schema, &json).unwrap();
            answers.push_str(&format!("{} \"\"\n", hex(&(entry.check)(&cdr, &dynamic))));
            messages += 1;
            bytes += cdr.len();
        }
        assert_eq!(peer.answer(&answers), "ok", "{name}");
        types += 1;
    }
    println!("{types} types, {messages} messages, {bytes} bytes each way");
}

/// Fields, defaults and constants, and the hash that ROS wrote beside each.
#[test]
fn definitions_are_those_of_ros() {
    let Some(venv) = support::ros() else { return };
    let mut theirs = support::packages(&venv);
    let mut ours = Packages::new();
    ours.add_folder(concat!(env!("CARGO_MANIFEST_DIR"), "/definitions"));
    let in_wheels = theirs.list();
    let wheels: BTreeSet<_> = in_wheels.iter().map(|name| name.package()).collect();
    let mut counts = [0; 3];
    for name in ours.list() {
        if !wheels.contains(name.package()) {
            continue;
        }
        let schema = ours.schema(&name).unwrap();
        assert_eq!(schema.to_text(), theirs.schema(&name).unwrap().to_text(), "{name}");
        for part in schema.referenced() {
            let [ours, theirs] =
                [&mut ours, &mut theirs].map(|from| from.schema(&part.name).unwrap().to_text());
            assert_eq!(ours, theirs, "{}", part.name);
        }
        let path = format!("share/{}/{}/{}.json", name.package(), name.kind().as_str(), name.name());
        let json = std::fs::read_to_string(venv.join(path)).unwrap();
        assert!(json.contains(&schema.hash().to_string()), "{name}");
        counts[[Kind::Msg, Kind::Srv, Kind::Action].iter().position(|&kind| kind == name.kind()).unwrap()] +=
            1;
    }
    let packages: BTreeSet<_> = ours.list().iter().map(|name| name.package().to_owned()).collect();
    let complete = in_wheels.iter().filter(|name| packages.contains(name.package())).count();
    assert_eq!(counts.iter().sum::<usize>(), complete, "no definition is missing");
    println!("{} messages, {} services, {} actions", counts[0], counts[1], counts[2]);
}
