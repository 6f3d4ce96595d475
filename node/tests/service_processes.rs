// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services between processes, some of which are killed.
#![cfg(feature = "example_interfaces")]

mod common;

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use common::{context, spin};
use futures::executor::block_on;
use futures::{FutureExt, StreamExt};
use tautline::example_interfaces::srv::AddTwoInts;
use tautline::{Error, Node, Qos, ServiceError};
use tautline_rt::clock::test_time;

const DOMAIN: u32 = 154;
const PART: &str = "TAUT_TEST_PART";

fn service(part: &str) -> String {
    format!("/{part}")
}

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Ok(part) = std::env::var(PART) else { return };
    let ctx = context(DOMAIN);
    let mut node = Node::create(ctx.clone(), "child", "").unwrap();
    let qos = Qos::default();
    let _spinning = spin(&ctx);
    match part.as_str() {
        "killed_client" => {
            let client = node.create_client::<AddTwoInts::Service>(&service(&part)).unwrap();
            block_on(client.wait_for_service().unwrap()).unwrap();
            let _answer = client.request(&AddTwoInts::Request { a: 1, b: 1 }).unwrap();
            println!("asked");
            block_on(futures::future::pending())
        }
        _ => {
            let mut requests =
                node.create_service::<AddTwoInts::Service>(&service(&part), qos).unwrap().owned();
            println!("serving");
            while let Some(request) = block_on(requests.next()) {
                let AddTwoInts::Request { a, b } = request.message;
                if b != 0 {
                    request.respond(AddTwoInts::Response { sum: a + b }).unwrap();
                } else {
                    println!("silent");
                    std::mem::forget(request);
                }
            }
        }
    }
}

struct Peer {
    child: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
}

impl Peer {
    fn start(part: &str) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "child_main", "--nocapture", "--test-threads=1"]).env(PART, part);
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Peer { child, lines }
    }

    /// Waits until it says so.
    fn expect(&mut self, word: &str) {
        assert!(self.lines.by_ref().map(Result::unwrap).any(|line| line.ends_with(word)), "{word}");
    }

    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_killed_server_ends_its_requests_and_a_new_one_takes_over() {
    let ctx = context(DOMAIN);
    let mut node = Node::create(ctx.clone(), "parent", "").unwrap();
    let name = service("killed_server");
    let client = node.create_client::<AddTwoInts::Service>(&name).unwrap();
    let _spinning = spin(&ctx);
    for round in 0..3 {
        let mut server = Peer::start("killed_server");
        server.expect("serving");
        block_on(client.wait_for_service().unwrap()).unwrap();
        let answer = block_on(client.request(&AddTwoInts::Request { a: round, b: 1 }).unwrap());
        assert_eq!(answer.unwrap().sum, round + 1);
        let mut silent = client.request(&AddTwoInts::Request { a: 0, b: 0 }).unwrap();
        server.expect("silent");
        assert!((&mut silent).now_or_never().is_none());
        server.kill();
        // The test's own limit: it must not hang.
        let error = block_on(silent).unwrap_err();
        assert!(matches!(error, Error::Service(ServiceError::ServerGone { .. })), "{error}");
        assert!(error.to_string().contains(&name), "{error}");
        let error = client.request(&AddTwoInts::Request { a: 0, b: 0 }).unwrap_err();
        assert!(matches!(error, Error::Service(ServiceError::NoServer { .. })), "{error}");
    }
}

#[test]
fn a_killed_client_is_forgotten() {
    let ctx = context(DOMAIN);
    let mut node = Node::create(ctx.clone(), "parent", "").unwrap();
    let name = service("killed_client");
    let mut requests = node.create_service::<AddTwoInts::Service>(&name, Qos::default()).unwrap().owned();
    let own = node.create_client::<AddTwoInts::Service>(&name).unwrap();
    let _spinning = spin(&ctx);
    for _ in 0..3 {
        let mut client = Peer::start("killed_client");
        client.expect("asked");
        let request = block_on(requests.next()).unwrap();
        client.kill();
        let sum = AddTwoInts::Response { sum: 2 };
        request.respond(sum).expect("whether the client has been missed yet or not");
        let answer = own
            .request_timeout(&AddTwoInts::Request { a: 2, b: 2 }, test_time(Duration::from_secs(30)))
            .unwrap();
        block_on(requests.next()).unwrap().respond(AddTwoInts::Response { sum: 4 }).unwrap();
        assert_eq!(block_on(answer).unwrap().sum, 4);
    }
}
