// SPDX-License-Identifier: MIT OR Apache-2.0
//! Definitions of types.

use tautline_schema::{
    HashedTypeDescription, Layout, Schema, SchemaError, TypeDescription, TypeName, parse_action,
    parse_message, parse_service,
};

use crate::allocations::Limit;

/// A line of two bytes is a field of some 250. The fixed part is for what errors say.
const SCHEMA: Limit = Limit { multiple: 256, fixed: 64 << 10 };

/// Reads definitions: the first byte chooses what the rest is.
pub fn schema(input: &[u8]) {
    let Some((&kind, text)) = input.split_first() else { return };
    let text = &*String::from_utf8_lossy(text);
    SCHEMA.check(text.len(), || match kind % 5 {
        0 => drop(parse_message(&name("demo_msgs/msg/Demo"), "Demo.msg", text)),
        1 => drop(parse_service(&name("demo_msgs/srv/Demo"), "Demo.srv", text)),
        2 => drop(parse_action(&name("demo_msgs/action/Demo"), "Demo.action", text)),
        3 => drop(bundle(text)),
        _ => description(text),
    });
}

fn name(text: &str) -> TypeName {
    text.parse().expect("a type's name")
}

fn bundle(text: &str) -> Result<(), SchemaError> {
    let demo = name("demo_msgs/msg/Demo");
    let schema = Schema::from_text(&demo, text)?;
    let again = Schema::from_text(&demo, &schema.to_text()).expect("our own text");
    assert_eq!((again.hash(), again.to_text()), (schema.hash(), schema.to_text()));
    assert_eq!(Layout::of(&again).size, Layout::of(&schema).size);
    let described = Schema::from_description(&TypeDescription::from(&schema)).expect("our own description");
    assert_eq!(described.hash(), schema.hash());
    Ok(())
}

fn description(text: &str) {
    let Ok(read) = serde_json::from_str::<HashedTypeDescription>(text) else { return };
    if let Ok(schema) = Schema::from_description(&read.type_description_msg) {
        let again = Schema::from_text(schema.name(), &schema.to_text()).expect("our own text");
        assert_eq!(again.hash(), schema.hash());
    }
}
