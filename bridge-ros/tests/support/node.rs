// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node of Tautline's in the test's own process.

use super::PATIENCE;
use futures::executor::block_on;
use futures::future::{Either, select};
use std::future::Future;
use std::pin::pin;
use std::thread::JoinHandle;
use tautline::{Context, Node, Realtime};

/// Its context spins until this is dropped.
pub struct Spinning {
    pub context: Context,
    pub node: Node,
    thread: Option<JoinHandle<()>>,
}

impl Spinning {
    pub fn new(domain: u32, name: &str) -> Self {
        let context = Context::builder().domain(domain).realtime(Realtime::Off).build().unwrap();
        let node = Node::create(context.clone(), name, "").unwrap();
        let sampler = context.clone();
        let thread = std::thread::spawn(move || sampler.spin().unwrap());
        Spinning { context, node, thread: Some(thread) }
    }

    /// Waits for it, with patience.
    pub fn wait<T>(&mut self, what: &str, future: impl Future<Output = T>) -> T {
        let mut timer = self.node.create_wall_timer(PATIENCE).unwrap();
        match block_on(select(pin!(future), pin!(timer.next_tick()))) {
            Either::Left((output, _)) => output,
            Either::Right(_) => panic!("{what}: not within {PATIENCE:?}"),
        }
    }
}

impl Drop for Spinning {
    fn drop(&mut self) {
        self.context.shutdown();
        if let Some(thread) = self.thread.take() {
            assert!(thread.join().is_ok() || std::thread::panicking());
        }
    }
}
