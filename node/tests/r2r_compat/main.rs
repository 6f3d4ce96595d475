// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs written for r2r 0.9.7 with a changed `use` line, feature by feature.
#![cfg(feature = "example_interfaces")]

#[cfg(feature = "action_msgs")]
mod actions;
mod services;

use futures::executor::LocalPool;
use std::cell::RefCell;
use std::rc::Rc;
use std::time::{Duration, Instant};
use tautline::{Context, Node, Realtime};

fn context(domain: u32) -> Context {
    Context::builder().domain(domain).realtime(Realtime::Off).build().unwrap()
}

/// What a program comes to in the end.
#[derive(Clone, Default)]
struct Done(Rc<RefCell<Option<Vec<i64>>>>);

impl Done {
    fn set(&self, result: Vec<i64>) {
        *self.0.borrow_mut() = Some(result);
    }
}

/// What has r2r's `spin_once`.
trait Spin {
    fn spin_some(&mut self, timeout: Duration);
}

impl Spin for Node {
    fn spin_some(&mut self, timeout: Duration) {
        self.spin_once(timeout);
    }
}

impl Spin for Context {
    fn spin_some(&mut self, timeout: Duration) {
        self.spin_once(timeout);
    }
}

/// The loop of r2r's examples; a test that would hang fails after a minute instead.
fn run(spin: &mut impl Spin, pool: &mut LocalPool, done: &Done) -> Vec<i64> {
    let start = Instant::now();
    loop {
        spin.spin_some(Duration::from_millis(100));
        pool.run_until_stalled();
        if let Some(result) = done.0.borrow_mut().take() {
            return result;
        }
        assert!(start.elapsed() < Duration::from_secs(60));
    }
}
