// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services between processes, some of which are killed.
#![cfg(feature = "example_interfaces")]

mod common;
#[path = "../../transport/tests/support/mod.rs"]
mod support;

use std::time::Duration;

use common::spinning_node;
use futures::executor::block_on;
use futures::{FutureExt, StreamExt};
use support::{Part, say};
use tautline::example_interfaces::srv::AddTwoInts;
use tautline::{Error, Qos, ServiceError};
use tautline_rt::clock::test_time;

const DOMAIN: u32 = 154;

fn service(part: &str) -> String {
    format!("/{part}")
}

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let (mut node, _spinning) = spinning_node(domain, "child");
    match part.as_str() {
        "killed_client" => {
            let client = node.create_client::<AddTwoInts::Service>(&service(&part)).unwrap();
            block_on(client.wait_for_service().unwrap()).unwrap();
            let _answer = client.request(&AddTwoInts::Request { a: 1, b: 1 }).unwrap();
            say("asked");
            block_on(futures::future::pending())
        }
        _ => {
            let requests = node.create_service::<AddTwoInts::Service>(&service(&part), Qos::default());
            let mut requests = requests.unwrap().owned();
            say("serving");
            while let Some(request) = block_on(requests.next()) {
                let AddTwoInts::Request { a, b } = request.message;
                if b != 0 {
                    request.respond(AddTwoInts::Response { sum: a + b }).unwrap();
                } else {
                    say("silent");
                    std::mem::forget(request);
                }
            }
        }
    }
}

#[test]
fn a_killed_server_ends_its_requests_and_a_new_one_takes_over() {
    let (mut node, _spinning) = spinning_node(DOMAIN, "parent");
    let name = service("killed_server");
    let client = node.create_client::<AddTwoInts::Service>(&name).unwrap();
    for round in 0..3 {
        let mut server = Part::start("killed_server", DOMAIN);
        assert_eq!(server.hear(), "serving");
        block_on(client.wait_for_service().unwrap()).unwrap();
        let answer = block_on(client.request(&AddTwoInts::Request { a: round, b: 1 }).unwrap());
        assert_eq!(answer.unwrap().sum, round + 1);
        let mut silent = client.request(&AddTwoInts::Request { a: 0, b: 0 }).unwrap();
        assert_eq!(server.hear(), "silent");
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
    let (mut node, _spinning) = spinning_node(DOMAIN, "parent");
    let name = service("killed_client");
    let mut requests = node.create_service::<AddTwoInts::Service>(&name, Qos::default()).unwrap().owned();
    let own = node.create_client::<AddTwoInts::Service>(&name).unwrap();
    for _ in 0..3 {
        let mut client = Part::start("killed_client", DOMAIN);
        assert_eq!(client.hear(), "asked");
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
