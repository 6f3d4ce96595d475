// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random messages of every generated type: owned and dynamic ones are the same, here and with a real ROS 2.

mod entry;
#[path = "../../../schema/tests/support/peer.rs"]
mod peer;
mod random;
mod ros;
#[path = "../../../schema/tests/support/mod.rs"]
mod support;

use std::sync::Arc;

use entry::entries;
use tautline_schema::DynamicMessage;

/// Messages per type.
const COUNT: usize = 100;

#[test]
fn owned_and_dynamic_messages_are_the_same() {
    let mut rng = tautline_seed::random();
    for entry in entries() {
        let schema = entry.schema();
        for _ in 0..COUNT {
            let message = random::message(&mut rng, &schema);
            (entry.check)(&message.to_cdr(), &message);
        }
    }
    println!("{} types, {} messages", entries().len(), COUNT * entries().len());
}

#[test]
fn hashes_and_defaults_are_those_of_the_definitions() {
    for entry in entries() {
        let schema: Arc<_> = entry.schema();
        assert_eq!(entry.hash, schema.hash().to_string(), "{}", entry.name);
        assert_eq!(entry.definition.unwrap().to_text(), schema.to_text(), "{}", entry.name);
        assert_eq!((entry.default)(), DynamicMessage::new(&schema).to_cdr(), "{}", entry.name);
    }
}
