// SPDX-License-Identifier: MIT OR Apache-2.0
//! Key expressions of topics: whatever is accepted is written as it was read.
#![no_main]

use libfuzzer_sys::fuzz_target;
use tautline_gateway::wire::TopicKey;

fuzz_target!(|text: &str| {
    if let Ok(key) = TopicKey::parse(text) {
        assert_eq!(key.to_string(), text);
    }
});
