// SPDX-License-Identifier: MIT OR Apache-2.0
//! [`fuzz::fill`], for libFuzzer.
#![no_main]

#[global_allocator]
static ALLOCATOR: fuzz::Counting = fuzz::Counting;

libfuzzer_sys::fuzz_target!(|input: &[u8]| fuzz::fill(input));
