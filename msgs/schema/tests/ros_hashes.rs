// SPDX-License-Identifier: MIT OR Apache-2.0
//! Every type of a real ROS 2 has the description and the hashes that ROS itself wrote.

mod support;

use std::fs;

use tautline_schema::{
    DynamicMessage, Endian, FieldDescription, FieldTypeDescription, HashedTypeDescription,
    IndividualTypeDescription, Kind, Schema, TypeDescription,
};

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

/// Of a type that only an IDL file can define: no type of ROS's own packages has such fields. The hash is that of rosidl_generator_type_description.
#[test]
fn characters_of_idl_files_are_other_types_than_those_of_msg_files() {
    let types = [
        ("narrow", 13, 0),
        ("wide", 14, 0),
        ("few", 61, 3),
        ("some", 110, 4),
        ("many", 157, 0),
        ("number", 3, 0),
    ];
    let field = |(name, type_id, capacity): (&str, u8, u64)| FieldDescription {
        name: name.to_owned(),
        ty: FieldTypeDescription { type_id, capacity, string_capacity: 0, nested_type_name: String::new() },
        default_value: String::new(),
    };
    let description = TypeDescription {
        type_description: IndividualTypeDescription {
            type_name: "letters_msgs/msg/Letters".to_owned(),
            fields: types.map(field).into(),
        },
        referenced_type_descriptions: Vec::new(),
    };
    let schema = Schema::from_description(&description).unwrap();
    assert_eq!(TypeDescription::from(&schema), description);
    let hash = "RIHS01_cca6cabc9e066533d3098c3f72729cef517a7ff1b9c18bafe8f86622a6b2b7e9";
    assert_eq!(schema.hash().to_string(), hash);
    let again = Schema::from_text(schema.name(), &schema.to_text()).unwrap();
    assert_eq!((again.hash(), TypeDescription::from(&again)), (schema.hash(), description));
    // As Fast CDR writes them.
    let body = [97, 0, 0xe9, 0, 1, 2, 3, 0, 1, 0, 0, 0, 0xac, 0x20, 0, 0, 1, 0, 0, 0, 98, 7];
    let message = DynamicMessage::from_body(&schema.into(), &body, Endian::Little).unwrap();
    assert_eq!(message.trailing_bytes(), 0);
    let expected = r#"{"narrow":97,"wide":233,"few":[1,2,3],"some":[8364],"many":[98],"number":7}"#;
    assert_eq!(message.to_json().replace(char::is_whitespace, ""), expected);
}
