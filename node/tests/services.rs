// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services in one process: owned and in place, many clients and servers, time-outs, cancelled requests, and every way to use them
//! wrongly.
#![cfg(all(feature = "example_interfaces", feature = "std_srvs"))]

mod common;

use std::time::Duration;

use common::{Log, context, spin, spinning_node};
use futures::executor::block_on;
use futures::future::join_all;
use futures::{FutureExt, StreamExt};
use tautline::example_interfaces::srv::AddTwoInts;
use tautline::std_srvs::srv::SetBool;
use tautline::{CallbackOptions, Error, Node, Qos, ServiceError, ServiceRequest};

const QOS: fn() -> Qos = Qos::default;

/// Answers with the sum until it is dropped.
fn serve(node: &mut Node, name: &str) -> tautline::CallbackHandle {
    let requests = node.create_service::<AddTwoInts::Service>(name, QOS()).unwrap().owned();
    let answer = |request: ServiceRequest<AddTwoInts::Service>| async move {
        let sum = request.message.a + request.message.b;
        request.respond(AddTwoInts::Response { sum }).unwrap();
    };
    node.spawn_callback(CallbackOptions::other(), requests.for_each(answer)).unwrap()
}

fn question(a: i64, b: i64) -> AddTwoInts::Request {
    AddTwoInts::Request { a, b }
}

#[test]
fn several_clients_get_their_own_answers() {
    let (mut node, _spinning) = spinning_node(31, "several");
    let _service = serve(&mut node, "several");
    let clients: Vec<_> =
        (0..4).map(|_| node.create_client::<AddTwoInts::Service>("/several").unwrap()).collect();
    for round in 0..100 {
        let ask =
            |(index, client): (i64, &tautline::Client<_>)| client.request(&question(round, index)).unwrap();
        let answers = block_on(join_all((0..).zip(&clients).map(ask)));
        let sums: Vec<_> = answers.into_iter().map(|answer| answer.unwrap().sum).collect();
        assert_eq!(sums, [round, round + 1, round + 2, round + 3]);
    }
}

#[test]
fn a_request_goes_to_every_server_and_the_first_answer_counts() {
    static ASKED: Log<&str> = Log::new();
    let (mut node, _spinning) = spinning_node(34, "servers");
    for name in ["one", "other"] {
        let requests = node.create_service::<SetBool::Service>("both", QOS()).unwrap().owned();
        let answer = move |request: ServiceRequest<SetBool::Service>| async move {
            ASKED.add(name);
            request.respond(SetBool::Response { success: true, message: name.into() }).unwrap();
        };
        node.spawn_callback(CallbackOptions::other().name(name), requests.for_each(answer)).unwrap();
    }
    let client = node.create_client::<SetBool::Service>("both").unwrap();
    assert_eq!(client.server_count(), 2);
    for _ in 0..10 {
        let answer = block_on(client.request(&SetBool::Request { data: true }).unwrap()).unwrap();
        assert!(answer.success && ["one", "other"].contains(&answer.message.as_str()));
    }
    let mut asked = ASKED.wait_for(20);
    asked.sort_unstable();
    assert_eq!(asked, [["one"; 10], ["other"; 10]].concat());
}

#[test]
fn in_place_both_ways_and_of_any_length() {
    use tautline::std_srvs::srv::SetBool::ResponseSizes;
    let (mut node, _spinning) = spinning_node(35, "in_place");
    let mut service = node.create_service::<SetBool::Service>("place", QOS()).unwrap();
    let client = node.create_client::<SetBool::Service>("place").unwrap();
    let long = "long ".repeat(10_000);
    let answer = long.clone();
    node.spawn_callback(CallbackOptions::other(), async move {
        while let Some(request) = service.next().await {
            assert_eq!(request.id().sequence_number, request.info().sequence_number);
            let text = if request.data { answer.as_str() } else { "" };
            let sizes = ResponseSizes { message: text.len() };
            let response = service.loan_with(&request, sizes).unwrap().write(|response| {
                response.success.set(true);
                response.message.set(text)
            });
            response.unwrap().send().unwrap();
        }
    })
    .unwrap();
    for data in [true, false, true] {
        let mut request = client.loan().unwrap();
        request.data = data;
        let response = block_on(client.send(request).unwrap()).unwrap();
        let expected = if data { long.as_str() } else { "" };
        assert_eq!((response.view().success(), response.view().message()), (true, expected));
    }
}

#[test]
fn a_service_without_a_server_is_an_error_and_can_be_waited_for() {
    let (mut node, _spinning) = spinning_node(36, "waiting");
    let client = node.create_client::<AddTwoInts::Service>("nobody").unwrap();
    let error = client.request(&question(1, 2)).unwrap_err();
    assert!(matches!(error, Error::Service(ServiceError::NoServer { .. })), "{error}");
    assert!(
        error.to_string().contains("'/nobody'") && error.to_string().contains("wait_for_service"),
        "{error}"
    );

    let waits = [client.wait_for_service().unwrap(), client.wait_for_service().unwrap()];
    assert!(client.wait_for_service().unwrap().now_or_never().is_none());
    let _service = serve(&mut node, "nobody");
    for wait in waits {
        block_on(wait).unwrap();
    }
    assert_eq!(block_on(client.request(&question(1, 2)).unwrap()).unwrap().sum, 3);
    assert!(client.wait_for_service().unwrap().now_or_never().is_some());
}

#[test]
fn a_server_that_ends_ends_its_requests() {
    let (mut node, _spinning) = spinning_node(37, "ending");
    let client = node.create_client::<AddTwoInts::Service>("ending").unwrap();
    let mut requests = node.create_service::<AddTwoInts::Service>("ending", QOS()).unwrap().owned();
    // Connected: what was answered comes before the end, although nobody takes it meanwhile.
    let first = client.request(&question(0, 0)).unwrap();
    block_on(requests.next()).unwrap().respond(AddTwoInts::Response { sum: 0 }).unwrap();
    block_on(first).unwrap();
    let taken = client.request(&question(1, 1)).unwrap();
    let waiting = client.request(&question(2, 2)).unwrap();
    let (request, requests) = block_on(requests.into_future());
    // The answer counts, although it is looked for after the end.
    request.unwrap().respond(AddTwoInts::Response { sum: 7 }).unwrap();
    drop(requests);
    assert_eq!(block_on(taken).unwrap().sum, 7);
    let error = block_on(waiting).unwrap_err();
    assert!(matches!(error, Error::Service(ServiceError::ServerGone { .. })), "{error}");
    assert!(error.to_string().contains("'/ending'"), "{error}");
    assert!(matches!(
        client.request(&question(1, 1)).unwrap_err(),
        Error::Service(ServiceError::NoServer { .. })
    ));
}

#[test]
fn another_server_that_got_the_request_may_still_answer() {
    let (mut node, _spinning) = spinning_node(38, "surviving");
    let client = node.create_client::<AddTwoInts::Service>("surviving").unwrap();
    let first = node.create_service::<AddTwoInts::Service>("surviving", QOS()).unwrap().owned();
    let second = node.create_service::<AddTwoInts::Service>("surviving", QOS()).unwrap().owned();
    let answer = client.request(&question(1, 2)).unwrap();
    drop(first);
    let (request, _second) = block_on(second.into_future());
    // One that came after the request does not keep it waiting.
    let _third = node.create_service::<AddTwoInts::Service>("surviving", QOS()).unwrap();
    request.unwrap().respond(AddTwoInts::Response { sum: 3 }).unwrap();
    assert_eq!(block_on(answer).unwrap().sum, 3);
    let answer = client.request(&question(1, 2)).unwrap();
    drop((_second, _third));
    assert!(block_on(answer).unwrap_err().to_string().contains("its server ended"));
}

#[test]
fn time_outs_and_requests_that_are_dropped() {
    let ctx = context(39);
    let mut node = Node::create(ctx.clone(), "slow", "").unwrap();
    let client = node.create_client::<AddTwoInts::Service>("slow").unwrap();
    let mut requests =
        node.create_service::<AddTwoInts::Service>("slow", Qos::keep_last(100)).unwrap().owned();
    // No time at all needs no sampler to pass.
    let error =
        client.request_timeout(&question(1, 1), Duration::ZERO).unwrap().now_or_never().unwrap().unwrap_err();
    assert!(matches!(error, Error::ServiceTimeout { .. }), "{error}");
    drop(requests.next().now_or_never().unwrap());
    let _spinning = spin(&ctx);
    let error =
        block_on(client.request_timeout(&question(1, 1), Duration::from_millis(1)).unwrap()).unwrap_err();
    assert!(error.to_string().contains("'/slow'") && error.to_string().contains("1ms"), "{error}");
    // Far more than can wait at once: each is dropped.
    for _ in 0..200 {
        drop(client.request(&question(1, 1)).unwrap());
        block_on(requests.next()).unwrap().respond(AddTwoInts::Response { sum: -1 }).unwrap();
    }
    // Answers that nobody waits for are no answers to what is asked next.
    let answer = client.request(&question(2, 2)).unwrap();
    block_on(requests.next()).unwrap().respond(AddTwoInts::Response { sum: -1 }).unwrap();
    block_on(requests.next()).unwrap().respond(AddTwoInts::Response { sum: 4 }).unwrap();
    assert_eq!(block_on(answer).unwrap().sum, 4);
}

#[test]
fn full_queues_are_errors_and_lose_nothing() {
    let (mut node, _spinning) = spinning_node(41, "full");
    let client = node.create_client::<AddTwoInts::Service>("full").unwrap();
    let mut requests = node.create_service::<AddTwoInts::Service>("full", Qos::keep_last(3)).unwrap().owned();
    let ask = |a| {
        let mut request = client.loan().unwrap();
        (request.a, request.b) = (a, 0);
        client.send(request)
    };
    let answers: Vec<_> = (0..3).map(|a| ask(a).unwrap()).collect();
    let unsent = ask(3).unwrap_err();
    assert!(matches!(unsent.error, ServiceError::RequestsFull { .. }), "{unsent}");
    assert!(unsent.to_string().contains("'/full'"), "{unsent}");
    let request = unsent.loan;
    assert_eq!(request.a, 3, "it comes back as it was");
    let first = block_on(requests.next()).unwrap();
    let fourth = client.send(request).unwrap();
    first.respond(AddTwoInts::Response { sum: 0 }).unwrap();
    for sum in 1..4 {
        let request = block_on(requests.next()).unwrap();
        assert_eq!(request.message.a, sum);
        request.respond(AddTwoInts::Response { sum }).unwrap();
    }
    let sums = block_on(join_all(answers.into_iter().chain([fourth])));
    let sums: Vec<_> = sums.into_iter().map(|sum| sum.unwrap().sum).collect();
    assert_eq!(sums, [0, 1, 2, 3]);
}

#[test]
fn more_pending_requests_than_a_client_can_have() {
    let (mut node, _spinning) = spinning_node(43, "many");
    let mut requests =
        node.create_service::<AddTwoInts::Service>("many", Qos::keep_last(100)).unwrap().owned();
    let client = node.create_client::<AddTwoInts::Service>("many").unwrap();
    let mut answers: Vec<_> =
        (0..tautline::MAX_PENDING_REQUESTS).map(|_| client.request(&question(1, 1)).unwrap()).collect();
    let error = client.request(&question(1, 1)).unwrap_err();
    assert!(matches!(error, Error::Service(ServiceError::TooManyPending { .. })), "{error}");
    assert!(client.wait_for_service().is_err(), "waiting takes a place as well");
    drop(answers.pop());
    answers.push(client.request(&question(2, 2)).unwrap());
    for _ in 0..=tautline::MAX_PENDING_REQUESTS {
        let request = block_on(requests.next()).unwrap();
        let sum = request.message.a + request.message.b;
        request.respond(AddTwoInts::Response { sum }).unwrap();
    }
    let sums = block_on(join_all(answers));
    assert!(sums.iter().rev().skip(1).all(|sum| sum.as_ref().unwrap().sum == 2));
    assert_eq!(sums.last().unwrap().as_ref().unwrap().sum, 4);
}

#[test]
fn another_type_is_another_service() {
    let mut node = Node::create(context(44), "types", "").unwrap();
    let _requests = node.create_service::<AddTwoInts::Service>("typed", QOS()).unwrap();
    let client = node.create_client::<SetBool::Service>("typed").unwrap();
    let error = client.request(&SetBool::Request { data: true }).map(drop).unwrap_err().to_string();
    assert!(error.contains("service '/typed' has no server"), "{error}");
    assert!(node.create_client::<SetBool::Service>("a b").is_err());
    assert!(node.get_topic_names_and_types().unwrap().is_empty(), "services are no topics");
    assert_eq!(node.get_service_names_and_types().unwrap()["/typed"], ["example_interfaces/srv/AddTwoInts"]);
    let clients = node.get_client_names_and_types_by_node("types", "/").unwrap();
    assert_eq!(clients["/typed"], ["std_srvs/srv/SetBool"]);
}

#[test]
fn answers_come_from_any_thread_and_in_any_order() {
    let (mut node, _spinning) = spinning_node(46, "threads");
    let requests =
        node.create_service::<AddTwoInts::Service>("threads", Qos::keep_last(100)).unwrap().owned();
    let client = std::sync::Mutex::new(node.create_client::<AddTwoInts::Service>("threads").unwrap());
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut requests = requests;
            for _ in 0..20 {
                let mut batch: Vec<_> = (0..8).map(|_| block_on(requests.next()).unwrap()).collect();
                batch.reverse();
                std::thread::scope(|scope| {
                    for request in batch {
                        scope.spawn(move || {
                            let sum = request.message.a + request.message.b;
                            request.respond(AddTwoInts::Response { sum }).unwrap();
                        });
                    }
                });
            }
        });
        for asker in 0..4 {
            let client = &client;
            scope.spawn(move || {
                for n in 0..20 {
                    let ask = |n| client.lock().unwrap().request(&question(asker, n)).unwrap();
                    let (one, other) = (ask(n), ask(-n));
                    // Polled in two threads: neither misses what the other one took.
                    std::thread::scope(|scope| {
                        scope.spawn(|| assert_eq!(block_on(one).unwrap().sum, asker + n));
                        assert_eq!(block_on(other).unwrap().sum, asker - n);
                    });
                }
            });
        }
    });
}

#[test]
fn a_client_that_goes_is_forgotten() {
    let (mut node, _spinning) = spinning_node(47, "leaving");
    let mut service = node.create_service::<AddTwoInts::Service>("leaving", QOS()).unwrap().owned();
    // More than the service can have at once.
    for n in 0..40 {
        let client = node.create_client::<AddTwoInts::Service>("leaving").unwrap();
        let answer = client.request(&question(n, 0)).unwrap();
        let request = block_on(service.next()).unwrap();
        if n % 2 == 0 {
            // The future outlives the client.
            drop(client);
            request.respond(AddTwoInts::Response { sum: n }).unwrap();
            assert_eq!(block_on(answer).unwrap().sum, n);
        } else {
            drop((client, answer));
            request.respond(AddTwoInts::Response { sum: n }).expect("nobody is there: no error, as in ROS 2");
        }
    }
}

#[cfg(feature = "untyped")]
#[test]
fn json_to_a_typed_server_and_a_typed_client_to_a_json_server() {
    use serde_json::json;
    use tautline::{Json, ServiceRequest};
    let (mut node, _spinning) = spinning_node(52, "json");
    let _service = serve(&mut node, "sum");
    let client = node.create_client_untyped("sum", "example_interfaces/srv/AddTwoInts").unwrap();
    let sum = block_on(client.request(&Json(json!({ "a": 40, "b": 2 }))).unwrap()).unwrap().unwrap();
    assert_eq!(sum, json!({ "sum": 42 }));
    assert!(client.request(&Json(json!({ "c": 1 }))).err().unwrap().to_string().contains('c'));

    let requests = node.create_service_untyped("flag", "std_srvs/srv/SetBool", QOS()).unwrap().owned();
    let answer = |request: ServiceRequest<Json>| async move {
        let message = request.message.as_ref().unwrap().to_string();
        request.respond(Json(json!({ "success": true, "message": message }))).unwrap();
    };
    node.spawn_callback(CallbackOptions::other(), requests.for_each(answer)).unwrap();
    let typed = node.create_client::<SetBool::Service>("flag").unwrap();
    let response = block_on(typed.request(&SetBool::Request { data: true }).unwrap()).unwrap();
    assert_eq!((response.success, response.message.as_str()), (true, r#"{"data":true}"#));

    let error = node.create_client_untyped("sum", "no_msgs/srv/None").unwrap_err().to_string();
    assert!(error.contains("no_msgs/srv/None"), "{error}");
}

/// The request is gone with the response that could not be sent: its client waits for nothing more.
#[cfg(feature = "untyped")]
#[test]
fn a_response_that_cannot_be_sent_ends_the_request() {
    use serde_json::json;
    use tautline::Json;
    let (mut node, _spinning) = spinning_node(52, "wrong_json");
    let requests = node.create_service_untyped("wrong_json", "std_srvs/srv/SetBool", QOS()).unwrap().owned();
    let respond = |request: tautline::ServiceRequest<Json>| async move {
        let error = request.respond(Json(json!({ "no such field": 1 }))).unwrap_err();
        assert!(error.to_string().contains("no such field"), "{error}");
    };
    node.spawn_callback(CallbackOptions::other(), requests.for_each(respond)).unwrap();
    let client = node.create_client::<SetBool::Service>("wrong_json").unwrap();
    assert!(block_on(client.request(&SetBool::Request { data: true }).unwrap()).is_err());
}

#[cfg(feature = "untyped")]
#[test]
fn json_is_read_and_answered_in_place() {
    use serde_json::json;
    use tautline::Json;
    let (mut node, _spinning) = spinning_node(52, "place_of_json");
    let mut server = node.create_service_untyped("json_in_place", "std_srvs/srv/SetBool", QOS()).unwrap();
    let serve = async move {
        while let Some(request) = server.next().await {
            assert_eq!(request.message().view(), [1], "the body of the request's CDR");
            assert_eq!(request.message().to_owned().unwrap(), json!({ "data": true }));
            let refused = server.respond(&request, &Json(json!({ "success": 3 }))).unwrap_err();
            assert!(refused.to_string().contains("success"), "{refused}");
            // Nothing was sent: the request still waits.
            server.respond(&request, &Json(json!({ "success": true, "message": "once" }))).unwrap();
        }
    };
    node.spawn_callback(CallbackOptions::other(), serve).unwrap();
    let client = node.create_client::<SetBool::Service>("json_in_place").unwrap();
    for _ in 0..2 {
        let response = block_on(client.request(&SetBool::Request { data: true }).unwrap()).unwrap();
        assert_eq!((response.success, response.message.as_str()), (true, "once"));
    }
}

/// What a server keeps of its type is enough for those who were built without it.
#[cfg(feature = "untyped")]
#[test]
fn the_kept_definition_of_a_service_has_its_hash() {
    use tautline::Service;
    use tautline_schema::Schema;
    fn check<S: Service>() {
        let kept = tautline_transport::ServiceType::of::<S>().request;
        let text = kept.definition.expect("generated types have one");
        let schema = Schema::from_text(&S::TYPE_NAME.parse().unwrap(), &text).unwrap();
        assert_eq!(schema.hash().to_string(), S::TYPE_HASH, "{text}");
    }
    check::<AddTwoInts::Service>();
    check::<SetBool::Service>();
    check::<tautline::std_srvs::srv::Trigger::Service>();
    check::<tautline::example_interfaces::action::Fibonacci::SendGoal::Service>();
    check::<tautline::example_interfaces::action::Fibonacci::GetResult::Service>();
}
