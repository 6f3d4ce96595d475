// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the tests share.
#![allow(dead_code, reason = "each test file uses its part")]

use std::sync::{Arc, Mutex};

use tautline_executor::CoreSet;
use tautline_rt::permission::{realtime_permitted, test_needs};
use tautline_rt::{Enforcement, prove_enforcement_by};

/// An ordered log of events.
#[derive(Clone, Default)]
pub struct Log(Arc<Mutex<Vec<String>>>);

impl Log {
    pub fn add(&self, event: impl Into<String>) {
        self.0.lock().unwrap().push(event.into());
    }

    pub fn events(&self) -> Vec<String> {
        self.0.lock().unwrap().clone()
    }
}

/// Real-time tests need the privilege; with CI set they must run. In `enforcer.rs` the enforcer enforces their budgets.
pub fn realtime() -> bool {
    let is_permitted = test_needs(realtime_permitted(50)).is_some();
    if is_permitted && env!("CARGO_CRATE_NAME") == "enforcer" {
        prove_enforcement_by(Enforcement::Enforcer, 50).unwrap();
    }
    is_permitted
}

/// The cores this process may use, in ascending order.
pub fn cores() -> Vec<usize> {
    CoreSet::allowed().unwrap().iter().collect()
}
