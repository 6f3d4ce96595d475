// SPDX-License-Identifier: MIT OR Apache-2.0
//! A length that bytes claim never makes the decoder allocate more than there are bytes.

#[path = "../../tests/support/heap.rs"]
mod heap;

use std::cell::Cell;
use std::sync::Arc;

use tautline_schema::{DynamicMessage, Endian, Schema};

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

#[global_allocator]
static ALLOCATOR: heap::Watched =
    heap::Watched(|bytes| LARGEST.set(LARGEST.get().max(bytes.unwrap_or_default())));

/// What a fault's path and text need.
const ERROR_BYTES: usize = 256;

#[test]
fn lengths_are_not_believed() {
    let others = "\n===\nMSG: demo_msgs/Outer\nInner a\n===\nMSG: demo_msgs/Inner\nuint8 a\nstring b\n";
    let types =
        "bool[] uint8[] float64[] float64[<=4000000000] string string[] wstring wstring[] Inner[] Outer[]";
    for ty in types.split(' ') {
        let text = format!("{ty} x{others}");
        let schema = Arc::new(Schema::from_text(&"demo_msgs/msg/Demo".parse().unwrap(), &text).unwrap());
        for bytes in [4, 64, 4096] {
            for len in [bytes as u32 / 8, bytes as u32, 1 << 20, 1 << 31, u32::MAX] {
                // Elements fail early: a bool of 255, a string of 4 GB without a zero.
                let mut body = vec![255; bytes];
                body[..4].copy_from_slice(&len.to_le_bytes());
                LARGEST.set(0);
                let decoded = DynamicMessage::from_body(&schema, &body, Endian::Little);
                let largest = LARGEST.get();
                assert!(largest <= bytes.max(ERROR_BYTES), "{ty}: {largest} bytes for {bytes}, {decoded:?}");
                assert!(decoded.is_err() || len as usize <= bytes, "{ty} {len}");
            }
        }
    }
}
