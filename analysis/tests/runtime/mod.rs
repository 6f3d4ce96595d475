// SPDX-License-Identifier: MIT OR Apache-2.0
//! A simulation of the runtime. node/tests/simulation.rs and rmw/tests/simulation.rs hold it against the runtime itself.
#![allow(dead_code, reason = "each test uses its part")]

pub mod machine;
pub mod made_up;
pub mod small;
pub mod waiting;
