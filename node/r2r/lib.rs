// SPDX-License-Identifier: MIT OR Apache-2.0
//! The programs of the test `programs` of the package `tautline-r2r`, run on r2r.
#![cfg(test)]

#[path = "../tautline-r2r/tests/programs/programs/mod.rs"]
mod programs;
