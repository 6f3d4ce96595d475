// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services of bytes: clients are met before they ask, answers outlive their server, requests are refused.

mod support;

use futures::FutureExt;
use support::{domain, wait_for};
use tautline_transport::{
    Limits, Participant, Qos, RawClient, RawPending, RawSample, RawServer, RequestId, ServiceError,
    ServiceType,
};

fn server(participant: &Participant, name: &str) -> RawServer {
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    participant.create_raw_server(name, &service_type, 10, Limits::SERVICE).unwrap()
}

fn client(participant: &Participant, name: &str) -> RawClient {
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    participant.create_raw_client(name, &service_type, Limits::SERVICE).unwrap()
}

fn ask(client: &RawClient, body: &[u8]) -> RawPending {
    let mut loan = client.loan(body.len()).unwrap();
    loan.copy_from_slice(body);
    client.send(loan).unwrap()
}

fn take(server: &mut RawServer) -> RawSample {
    let mut request = None;
    wait_for("a request", || {
        request = server.try_take().unwrap();
        request.is_some()
    });
    request.unwrap()
}

fn respond(server: &RawServer, request: &RawSample, body: &[u8]) {
    let mut response = server.responders().loan(RequestId::of(request.info()), body.len()).unwrap();
    response.copy_from_slice(body);
    response.send().unwrap();
}

#[test]
fn an_answer_outlives_its_server_though_nobody_has_looked_for_it() {
    let [here, there] = [(); 2].map(|()| Participant::new(domain(63)).unwrap());
    let client = client(&here, "/met");
    let mut server = server(&there, "/met");
    wait_for("the server to meet the client", || {
        assert!(server.try_take().unwrap().is_none());
        server.responders().len() == 1
    });
    let pending = ask(&client, b"first");
    let request = take(&mut server);
    assert_eq!(request.body(), b"first");
    respond(&server, &request, b"answer");
    drop(request);
    drop(server);
    assert_eq!(pending.now_or_never().unwrap().unwrap().body(), b"answer");
    let unsent = client.send(client.loan(0).unwrap()).unwrap_err();
    assert!(matches!(unsent.error, ServiceError::NoServer { .. }), "{unsent}");
}

#[test]
fn a_client_that_waits_and_cannot_be_reached_is_not_taken_for_gone() {
    let participant = Participant::new(domain(63)).unwrap();
    let client = client(&participant, "/crowded");
    // All that its answers' topic has room for.
    let topic = format!("response:{:?}", client.gid());
    let response_type = ServiceType::new("test_srvs/srv/Bytes", None).response;
    let publisher = || {
        participant.create_raw_publisher(&topic, &response_type, Qos::keep_all(1), Limits::SERVICE).unwrap()
    };
    let crowd: Vec<_> = (0..Limits::SERVICE.subscribers).map(|_| publisher()).collect();
    let mut server = server(&participant, "/crowded");
    let first = ask(&client, b"first");
    let first_request = take(&mut server);
    let error = server.responders().loan(RequestId::of(first_request.info()), 0).unwrap_err();
    assert!(matches!(error, ServiceError::ClientUnreachable { .. }), "{error}");
    assert!(!server.responders().contains(client.gid()));
    // Its next request tries again; what it asked before can be answered then.
    drop(crowd);
    let second = ask(&client, b"second");
    let second_request = take(&mut server);
    assert!(server.responders().contains(client.gid()));
    for (pending, request) in [(first, first_request), (second, second_request)] {
        respond(&server, &request, b"answer");
        assert_eq!(pending.now_or_never().unwrap().unwrap().body(), b"answer");
    }
    let id = RequestId { client: publisher().gid(), sequence_number: 1 };
    let error = server.responders().loan(id, 0).unwrap_err();
    assert!(matches!(error, ServiceError::ClientGone { .. }), "{error}");
}

#[test]
fn clients_come_and_go() {
    let participant = Participant::new(domain(63)).unwrap();
    let mut server = server(&participant, "/visited");
    let mut met = |n| {
        wait_for("the clients there are", || {
            assert!(server.try_take().unwrap().is_none());
            server.responders().len() == n
        });
    };
    for _ in 0..3 {
        let clients: Vec<_> = (0..4).map(|_| client(&participant, "/visited")).collect();
        met(4);
        drop(clients);
        met(0);
    }
    // One that asks before it was met.
    let client = client(&participant, "/visited");
    let pending = ask(&client, b"?");
    let request = take(&mut server);
    respond(&server, &request, b"!");
    assert_eq!(pending.now_or_never().unwrap().unwrap().body(), b"!");
}

#[test]
fn a_request_that_is_refused_has_no_answer_and_others_have_theirs() {
    let participant = Participant::new(domain(63)).unwrap();
    let mut server = server(&participant, "/refusing");
    let client = client(&participant, "/refusing");
    let [refused, answered] = [(); 2].map(|()| ask(&client, b"?"));
    let [first, second] = [(); 2].map(|()| take(&mut server));
    server.responders().refuse(RequestId::of(first.info())).unwrap();
    respond(&server, &second, b"!");
    assert_eq!(answered.now_or_never().unwrap().unwrap().body(), b"!");
    let error = refused.now_or_never().unwrap().unwrap_err();
    assert!(matches!(error, ServiceError::ServerGone { .. }), "{error}");
    // Too late, and nobody's.
    server.responders().refuse(RequestId::of(second.info())).unwrap();
    drop(client);
    wait_for("the client to be forgotten", || {
        assert!(server.try_take().unwrap().is_none());
        server.responders().is_empty()
    });
    let error = server.responders().refuse(RequestId::of(first.info())).unwrap_err();
    assert!(matches!(error, ServiceError::ClientGone { .. }), "{error}");
}

#[test]
fn an_answer_that_has_no_place_yet_is_waited_for_though_its_server_has_gone() {
    let participant = Participant::new(domain(63)).unwrap();
    let mut server = server(&participant, "/hoarding");
    let client = client(&participant, "/hoarding");
    let mut held = Vec::new();
    let mut pending = loop {
        let mut pending = ask(&client, b"?");
        let request = take(&mut server);
        respond(&server, &request, b"!");
        match (&mut pending).now_or_never() {
            Some(response) => held.push(response.unwrap()),
            None => break pending,
        }
    };
    assert!(held.len() >= tautline_transport::MAX_PENDING_REQUESTS, "{}", held.len());
    drop(server);
    assert!((&mut pending).now_or_never().is_none(), "its answer is there, but no more can be held");
    let unanswered = client.send(client.loan(0).unwrap()).is_ok();
    held.pop();
    assert_eq!(pending.now_or_never().unwrap().unwrap().body(), b"!");
    assert_eq!(
        (unanswered, client.server_count()),
        (true, 0),
        "by then it is known that the server has gone"
    );
}
