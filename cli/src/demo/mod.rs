// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut demo`: five periodic topics on one core, measured beside their prediction.
#![allow(dead_code)]
mod plot;
mod report;
