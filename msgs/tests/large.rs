// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages larger than the stack: what is wrong with one is said without reading it onto the stack.

use tautline_msgs::cdr::{DecodeFault, Endian, Reader, View};
use tautline_msgs::{Body, Message, dense_struct};

const BYTES: usize = 4 << 20;

#[derive(Message, Clone, Copy)]
#[message(name = "test_msgs/msg/Large", crate = "tautline_msgs")]
#[repr(C)]
struct Large {
    data: [u8; BYTES],
    ok: bool,
}

impl Default for Large {
    fn default() -> Self {
        Self { data: [0; BYTES], ok: false }
    }
}

dense_struct! { Large }

fn on_a_small_stack(test: impl FnOnce() + Send + 'static) {
    std::thread::Builder::new().stack_size(256 << 10).spawn(test).unwrap().join().unwrap();
}

#[test]
fn a_large_message_that_is_invalid() {
    on_a_small_stack(|| {
        let mut memory = vec![0u8; BYTES + 40];
        let start = memory.as_ptr().align_offset(8);
        let memory = &mut memory[start..];
        let fault = |memory: &[u8], len| {
            let error = Large::view(Body::new(memory, len).unwrap()).err().unwrap();
            (error.offset, error.fault)
        };
        assert!(Large::view(Body::new(memory, BYTES + 1).unwrap()).is_ok());
        assert_eq!(fault(memory, 8), (0, DecodeFault::End { needed: BYTES + 1, left: 8 }));
        let trailing = DecodeFault::Trailing { len: 9, most: 8 };
        assert_eq!(fault(memory, BYTES + 10), (BYTES + 1, trailing));
        memory[BYTES] = 2;
        let value = DecodeFault::Value { value: 2, type_name: &"value of its field" };
        assert_eq!(fault(memory, BYTES + 1), (BYTES, value));
    });
}

#[test]
fn a_large_message_within_one_that_is_invalid() {
    on_a_small_stack(|| {
        let mut body = vec![0; 2 * (BYTES + 1)];
        assert!(list(&body) && one(&body));
        assert!(!list(&body[1..]) && !one(&body[..8]));
        body[BYTES] = 2;
        assert!(!list(&body) && !one(&body));
    });
}

fn one(body: &[u8]) -> bool {
    Large::view_value(&mut Reader::new(body, Endian::Little)).is_ok()
}

fn list(body: &[u8]) -> bool {
    Large::view_list(&mut Reader::new(body, Endian::Little), 2).is_ok()
}
