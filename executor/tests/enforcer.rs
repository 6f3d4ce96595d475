// SPDX-License-Identifier: MIT OR Apache-2.0
//! Budgets that the enforcer enforces, as on a kernel whose timers do not reach a busy thread: the tests of demotion and suspension.

#![allow(clippy::duplicate_mod, reason = "both use the same helpers")]

#[path = "demotion.rs"]
mod demotion;
#[path = "suspension.rs"]
mod suspension;
