// SPDX-License-Identifier: MIT OR Apache-2.0
//! [`fuzz::system`], for libFuzzer.
#![no_main]

#[global_allocator]
static ALLOCATOR: fuzz::Counting = fuzz::Counting;

libfuzzer_sys::fuzz_target!(|input: &[u8]| fuzz::system(input));
