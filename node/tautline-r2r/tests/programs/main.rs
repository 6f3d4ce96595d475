// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs for r2r 0.9.7, run on Tautline.
#![allow(clippy::clone_on_copy, reason = "r2r's QosProfile is not Copy")]

extern crate tautline_r2r as r2r;

mod programs;
