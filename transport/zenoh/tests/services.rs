// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services of one host, asked from another: requests and answers as bytes, ends that come and go.

mod support;

use futures::FutureExt;
use std::sync::{Arc, Mutex};
use support::{Host, until, wait};
use tautline_gateway::wire::EndpointKind;
use tautline_transport::{
    Limits, Participant, RawClient, RawPending, RawSample, RawServer, ServiceError, ServiceType,
};
use zenoh::Wait;

/// Some type of bytes.
fn service_type() -> ServiceType {
    let hash = format!("RIHS01_{}", "7".repeat(64));
    ServiceType::new("some_srvs/srv/Bytes", Some(&hash))
}

/// As a node of this host.
fn of_node(host: &Host, name: &str) -> Participant {
    host.participant.for_node(&host.participant.create_node(name, "/").unwrap())
}

fn server(host: &Host) -> RawServer {
    of_node(host, "answering").create_raw_server("/trigger", &service_type(), 10, Limits::default()).unwrap()
}

fn client(host: &Host) -> RawClient {
    of_node(host, "asking").create_raw_client("/trigger", &service_type(), Limits::default()).unwrap()
}

fn ask(client: &RawClient, body: &[u8]) -> RawPending {
    let mut loan = client.loan(body.len()).unwrap();
    loan.copy_from_slice(body);
    client.send(loan).unwrap()
}

/// Takes a request and answers it with what it says, twice.
fn serve(server: &RawServer) -> Vec<u8> {
    let request = wait("a request", || server.try_take().unwrap());
    let asked = request.body().to_vec();
    let id = tautline_transport::RequestId::of(request.info());
    let mut response = server.loan(id, asked.len() * 2).unwrap();
    response.copy_from_slice(&asked.repeat(2));
    response.send().unwrap();
    asked
}

fn response(mut pending: RawPending) -> Result<RawSample, ServiceError> {
    wait("a response", || (&mut pending).now_or_never())
}

#[test]
fn a_service_of_another_host() {
    let a = Host::first(101, 101);
    let b = Host::beside(&a, 102);
    let server = server(&a);
    let client = client(&b);
    until("the service", || client.server_count() == 1);
    for size in [0, 1, 64, 1000, 100_000] {
        let body: Vec<u8> = (0..size).map(|n: usize| (n * 7 + size) as u8).collect();
        let pending = ask(&client, &body);
        assert!(serve(&server) == body, "{size} bytes differ");
        assert!(response(pending).unwrap().body() == body.repeat(2), "{size} bytes differ");
    }
    // Several at once, answered in another order by whoever takes them.
    let pending: Vec<_> = (0..5u8).map(|n| ask(&client, &[n])).collect();
    for _ in &pending {
        serve(&server);
    }
    for (n, pending) in pending.into_iter().enumerate() {
        assert_eq!(response(pending).unwrap().body(), [n as u8; 2]);
    }
    // Both ends are announced, with their nodes.
    let tokens = |host: &Host, kind| {
        let remote = host.gateway().remote();
        let of_kind = |token: &&tautline_gateway::wire::Token| {
            token.endpoint.as_ref().is_some_and(|end| end.kind == kind && end.name == "/trigger")
        };
        remote.iter().filter(of_kind).map(|token| token.node.full_name()).collect::<Vec<_>>()
    };
    assert_eq!(tokens(&b, EndpointKind::Service), ["/answering"]);
    until("the client's token", || tokens(&a, EndpointKind::Client) == ["/asking"]);

    // With the server, what stands for it goes, and with that what waits.
    let pending = ask(&client, b"last");
    until("the request", || {
        server.requests().counters().received() > 0 && server.try_take().unwrap().is_some()
    });
    drop(server);
    let error = response(pending).unwrap_err();
    assert!(matches!(error, ServiceError::ServerGone { .. }), "{error}");
    until("what stood for it to go", || client.server_count() == 0);
}

/// Requests that nobody answers take no places from others for ever: the oldest are given up, and those who asked told.
#[test]
fn requests_without_an_answer_keep_nobody_from_asking() {
    let a = Host::first(105, 105);
    let b = Host::beside(&a, 106);
    let server = server(&a);
    let clients: Vec<RawClient> = (0..18).map(|_| client(&b)).collect();
    until("the service", || clients.iter().all(|client| client.server_count() == 1));
    let (last, silent) = clients.split_last().unwrap();
    let mut pending = Vec::new();
    for client in silent {
        for _ in 0..64 {
            pending.push(ask(client, b"silent"));
            wait("the request", || server.try_take().unwrap());
        }
    }
    let asked = ask(last, b"last");
    assert_eq!(serve(&server), b"last");
    assert_eq!(response(asked).unwrap().body(), b"lastlast");
    // The first of 17 x 64 + 1, of which 16 x 64 have places.
    let error = response(pending.remove(0)).unwrap_err();
    assert!(matches!(error, ServiceError::ServerGone { .. }), "{error}");
    assert!((&mut pending.pop().unwrap()).now_or_never().is_none());
}

#[test]
fn a_service_of_this_host_is_asked_here() {
    let a = Host::first(103, 103);
    let b = Host::beside(&a, 104);
    let far = server(&a);
    let client = client(&b);
    until("the service elsewhere", || client.server_count() == 1);
    let near = server(&b);
    // The one that stood for the other host's goes; for a moment both are there.
    until("the service here", || client.server_count() == 1);
    let pending = ask(&client, b"here");
    assert_eq!(serve(&near), b"here");
    assert_eq!(response(pending).unwrap().body(), b"herehere");
    assert!(far.try_take().unwrap().is_none());
}

/// A server on the network that takes requests and says nothing, or that it will not: whoever asked hears of it, and at once.
#[test]
fn who_gets_no_answer_does_not_wait_for_it() {
    use zenoh::Wait;
    let host = Host::first(66, 66);
    let text = format!(
        r#"{{ mode: "client", connect: {{ endpoints: ["{}"] }}, scouting: {{ multicast: {{ enabled: false }} }} }}"#,
        host.locator()
    );
    let session = zenoh::open(zenoh::Config::from_json5(&text).unwrap()).wait().unwrap();
    let hash = service_type().request.hash.unwrap();
    let key = format!("66/trigger/some_srvs::srv::dds_::Bytes_/{hash}");
    let queries = session.declare_queryable(key).complete(true).wait().unwrap();
    let token =
        format!("@ros2_lv/66/1/0/1/SS/%/%/theirs/%trigger/some_srvs::srv::dds_::Bytes_/{hash}/::,10:,:,:,,");
    let _token = session.liveliness().declare_token(token).wait().unwrap();
    let client = client(&host);
    until("their service", || client.server_count() == 1);

    let query = |pending: &RawPending| {
        let query = queries.recv().unwrap();
        let attachment = query.attachment().unwrap().to_bytes();
        assert_eq!(attachment[..8], pending.sequence_number().to_le_bytes());
        query
    };
    let reply = |query: &zenoh::query::Query, payload: &[u8]| {
        let attachment = query.attachment().unwrap().clone();
        query.reply(query.key_expr().clone(), payload).attachment(attachment).wait().unwrap();
    };
    let gone = |pending| {
        let error = response(pending).unwrap_err();
        assert!(matches!(error, ServiceError::ServerGone { .. }), "{error}");
    };
    let silent = ask(&client, b"silent");
    drop(query(&silent));
    gone(silent);
    let refused = ask(&client, b"refused");
    query(&refused).reply_err("no").wait().unwrap();
    gone(refused);
    let nonsense = ask(&client, b"nonsense");
    reply(&query(&nonsense), b"no encapsulation");
    gone(nonsense);
    let answered = ask(&client, b"answered");
    reply(&query(&answered), &[0, 1, 0, 0, 7]);
    assert_eq!(response(answered).unwrap().body(), [7]);
    assert_eq!(client.server_count(), 1, "it is still there");
}

/// One on another host that never answers: a bounded number of requests is pending there, and those of ended clients make room.
#[test]
fn a_silent_server_holds_a_bounded_number_of_requests() {
    const MOST: usize = 4096;
    let host = Host::first(84, 84);
    let silent = host.session();
    let hash = format!("RIHS01_{}", "7".repeat(64));
    let name = format!("some_srvs::srv::dds_::Bytes_/{hash}");
    let queries = Arc::<Mutex<Vec<zenoh::query::Query>>>::default();
    let held = queries.clone();
    let server = silent.declare_queryable(format!("84/trigger/{name}")).complete(true);
    let _server = server.callback(move |query| held.lock().unwrap().push(query)).wait().unwrap();
    let token = format!("@ros2_lv/84/bad/0/1/SS/%/%/silent/%trigger/{name}/::,10:,:,:,,");
    let _token = silent.liveliness().declare_token(token).wait().unwrap();

    let mut clients: Vec<_> = (0..65).map(|_| client(&host)).collect();
    until("the service", || clients.iter().all(|client| client.server_count() == 1));
    let mut pending: Vec<Vec<_>> =
        clients.iter().map(|client| (0..64).map(|n| ask(client, &[n])).collect()).collect();
    let held = || queries.lock().unwrap().len();
    until("as many as may be pending", || held() >= MOST);
    let uptime = host.stats().uptime_s;
    until("new numbers", || host.stats().uptime_s > uptime);
    assert_eq!(held(), MOST);
    drop((clients.remove(0), pending.remove(0)));
    until("those that waited", || held() == 65 * 64);
}
