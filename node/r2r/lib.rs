// SPDX-License-Identifier: MIT OR Apache-2.0
//! The programs of the test `r2r_programs` of the package `tautline`, run on r2r.
#![cfg(test)]

#[path = "../tests/r2r_programs/programs/mod.rs"]
mod programs;
