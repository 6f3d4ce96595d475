// SPDX-License-Identifier: MIT OR Apache-2.0
//! Liveliness tokens: whatever is accepted can be written and read again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use tautline_gateway::wire::{Token, WireQos, endpoint_gid};

fuzz_target!(|text: &str| {
    if let Ok(token) = Token::parse(text) {
        assert_eq!(Token::parse(&token.to_string()), Ok(token.clone()));
        endpoint_gid(&token);
    }
    if let Ok(qos) = WireQos::parse(text) {
        assert_eq!(WireQos::parse(&qos.to_string()), Ok(qos));
    }
});
