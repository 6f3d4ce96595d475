// SPDX-License-Identifier: MIT OR Apache-2.0
//! [`fuzz::bag`], for libFuzzer.
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| fuzz::bag(input));
