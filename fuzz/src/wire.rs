// SPDX-License-Identifier: MIT OR Apache-2.0
//! What other hosts send beside messages.

use tautline_wire::{Attachment, Token, TopicKey, WireQos, check_encapsulation, endpoint_gid};

use crate::allocations::Limit;

/// Names are kept as text, some with a slash before each part. The fixed part is for what was written again.
const WIRE: Limit = Limit { multiple: 4, fixed: 8 << 10 };

/// Reads what came over the network: the first byte chooses what the rest is.
pub fn wire(input: &[u8]) {
    let Some((&kind, bytes)) = input.split_first() else { return };
    let text = &*String::from_utf8_lossy(bytes);
    WIRE.check(bytes.len(), || match kind % 4 {
        0 => token(text),
        1 => {
            if let Ok(key) = TopicKey::parse(text) {
                assert_eq!(key.to_string(), text);
            }
        }
        2 => {
            if let Ok(qos) = WireQos::parse(text) {
                assert_eq!(WireQos::parse(&qos.to_string()), Ok(qos));
            }
        }
        _ => {
            let _ = check_encapsulation(bytes);
            if let Ok(attachment) = Attachment::parse(bytes) {
                assert_eq!(attachment.encode(), bytes);
            }
        }
    });
}

fn token(text: &str) {
    let Ok(token) = Token::parse(text) else { return };
    assert_eq!(Token::parse(&token.to_string()), Ok(token.clone()));
    endpoint_gid(&token);
}
