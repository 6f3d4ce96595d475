// SPDX-License-Identifier: MIT OR Apache-2.0
//! Signals as Tautline's messages.
#![allow(dead_code, reason = "each process uses its part")]

tautline_alks::messages!(tautline);
