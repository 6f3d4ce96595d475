// SPDX-License-Identifier: MIT OR Apache-2.0
//! Every type of a real ROS 2 has the description and the hashes that ROS itself wrote.

mod support;

use std::fs;

use tautline_schema::{HashedTypeDescription, Kind, Schema, TypeDescription};

#[test]
fn descriptions_and_hashes_are_those_of_ros() {
    let Some(venv) = support::ros() else { return };
    let mut packages = support::packages(&venv);
    let names = packages.list();
    let mut counts = [0; 3];
    let mut hashes = 0;
    for name in &names {
        let schema = packages.schema(name).unwrap();
        let path = format!("share/{}/{}/{}.json", name.package(), name.kind().as_str(), name.name());
        let theirs = fs::read_to_string(venv.join(path)).unwrap();
        let ours = HashedTypeDescription::from(&schema);
        assert_eq!(ours.to_json(), theirs, "{name}");
        assert_eq!(ours.type_hashes[0].hash_string, schema.hash().to_string());
        hashes += ours.type_hashes.len();
        counts[[Kind::Msg, Kind::Srv, Kind::Action].iter().position(|&kind| kind == name.kind()).unwrap()] +=
            1;

        // The other two sources of schemas give the same.
        let read: HashedTypeDescription = serde_json::from_str(&theirs).unwrap();
        let again = Schema::from_description(&read.type_description_msg).unwrap();
        assert_eq!(TypeDescription::from(&again), read.type_description_msg);
        assert_eq!(again.hash(), schema.hash());
        let text = schema.to_text();
        let again = Schema::from_text(name, &text).unwrap();
        assert_eq!((again.hash(), again.to_text()), (schema.hash(), text));
        assert_eq!(HashedTypeDescription::from(&again).to_json(), theirs, "{name}");
    }
    println!("{} messages, {} services, {} actions; {hashes} hashes", counts[0], counts[1], counts[2]);
    assert!(counts[0] >= 160 && counts[1] >= 25 && counts[2] >= 2, "{counts:?}");
}
