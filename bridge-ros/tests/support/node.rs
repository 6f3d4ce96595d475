// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node of Tautline's in the test's own process.

use super::PATIENCE;
use futures::StreamExt;
use futures::executor::block_on;
use futures::future::{Either, select};
use std::future::Future;
use std::pin::pin;
use std::thread::JoinHandle;
use tautline::codec::ServiceCodec;
use tautline::test_msgs::srv::BasicTypes;
use tautline::{CallbackHandle, CallbackOptions, Client, Context, Node, Qos, Realtime};

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
        match block_on(select(pin!(future), pin!(timer.tick()))) {
            Either::Left((output, _)) => output,
            Either::Right(_) => panic!("{what}: not within {PATIENCE:?}"),
        }
    }

    /// Waits for the server of a client.
    pub fn available<T: ServiceCodec>(&mut self, client: &Client<T>) {
        self.wait("a server", client.wait_for_service().unwrap()).unwrap();
    }
}

/// Answers each request with what it says, on a thread of its own.
pub fn serve_echo(node: &mut Node, name: &str) -> CallbackHandle {
    let requests = node.create_service::<BasicTypes::Service>(name, Qos::default()).unwrap().owned();
    let answer = requests.for_each(|request| async move {
        let json = serde_json::to_value(&request.message).unwrap();
        request.respond(serde_json::from_value(json).unwrap()).unwrap();
    });
    node.spawn_callback(CallbackOptions::other(), answer).unwrap()
}

/// As the action's server in `ros_services_peer.py` counts.
pub fn fibonacci(order: usize) -> Vec<i32> {
    let mut sequence = vec![0, 1];
    while sequence.len() <= order {
        sequence.push((sequence[sequence.len() - 1] + sequence[sequence.len() - 2]) % 1000);
    }
    sequence
}

impl Drop for Spinning {
    fn drop(&mut self) {
        self.context.shutdown();
        if let Some(thread) = self.thread.take() {
            assert!(thread.join().is_ok() || std::thread::panicking());
        }
    }
}
