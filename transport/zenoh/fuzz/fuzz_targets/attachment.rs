// SPDX-License-Identifier: MIT OR Apache-2.0
//! Attachments and encapsulations: whatever is accepted is written as it was read.
#![no_main]

use libfuzzer_sys::fuzz_target;
use tautline_gateway::wire::{Attachment, check_encapsulation};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(attachment) = Attachment::parse(bytes) {
        assert_eq!(attachment.encode(), bytes);
    }
    let _ = check_encapsulation(bytes);
});
