// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services of bytes: clients are met before they ask, answers outlive their server, requests are refused.

mod support;

use futures::FutureExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Wake, Waker};
use support::{Part, clean, domain, folder, participants, say, wait_for, wait_for_some, wait_for_the_end};
use tautline_transport::{
    Limits, Participant, RawClient, RawPending, RawSample, RawServer, RawSubscription, RequestId,
    ServiceError, ServiceType, TransportError,
};

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    assert_eq!(part, "server without memory");
    let before = participants(domain);
    let participant = Participant::new(domain).unwrap();
    let own = participants(domain).into_iter().find(|name| !before.contains(name)).unwrap();
    let server = server(&participant, "/crowded");
    // From here on its file cannot grow: there is no memory for the responses of a client that comes.
    let len = std::fs::metadata(folder(domain).join(own)).unwrap().len();
    // SAFETY: ignoring a signal touches no memory.
    assert_ne!(unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) }, libc::SIG_ERR);
    limit_files(Some(len));
    say("serves");
    let first = take(&server);
    let error = server.loan(RequestId::of(first.info()), 0).unwrap_err();
    assert!(matches!(error, ServiceError::ClientUnreachable { .. }), "{error}");
    assert!(!server.can_answer(first.info().publisher_gid) && server.client_count() == 0);
    limit_files(None);
    // Nothing calls for it: it is tried again.
    wait_for("the client to be reached", || server.can_answer(first.info().publisher_gid));
    respond(&server, &first, b"answer");
    say("answered");
    let second = take(&server);
    respond(&server, &second, b"answer");
    wait_for_the_end();
}

/// The greatest length that files of this process get; as long as they like without one.
fn limit_files(len: Option<u64>) {
    use rustix::process::{Resource, getrlimit, setrlimit};
    let limit = rustix::process::Rlimit { current: len, ..getrlimit(Resource::Fsize) };
    setrlimit(Resource::Fsize, limit).unwrap();
}

fn server(participant: &Participant, name: &str) -> RawServer {
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    participant.create_raw_server(name, &service_type, 10, Limits::default()).unwrap()
}

fn client(participant: &Participant, name: &str) -> RawClient {
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    participant.create_raw_client(name, &service_type, Limits::default()).unwrap()
}

fn ask(client: &RawClient, body: &[u8]) -> RawPending {
    let mut loan = client.loan(body.len()).unwrap();
    loan.copy_from_slice(body);
    client.send(loan).unwrap()
}

fn take(server: &RawServer) -> RawSample {
    wait_for_some("a request", || server.try_take().unwrap())
}

fn respond(server: &RawServer, request: &RawSample, body: &[u8]) {
    let mut response = server.loan(RequestId::of(request.info()), body.len()).unwrap();
    response.copy_from_slice(body);
    response.send().unwrap();
}

#[test]
fn an_answer_outlives_its_server_though_nobody_has_looked_for_it() {
    let [here, there] = [(); 2].map(|()| Participant::new(domain(63)).unwrap());
    let client = client(&here, "/met");
    let server = server(&there, "/met");
    wait_for("the server to meet the client", || server.client_count() == 1);
    wait_for("the client to meet the server", || client.server_count() == 1);
    let pending = ask(&client, b"first");
    let request = take(&server);
    assert_eq!(request.body(), b"first");
    respond(&server, &request, b"answer");
    drop(request);
    drop(server);
    assert_eq!(pending.now_or_never().unwrap().unwrap().body(), b"answer");
    wait_for("the server's end", || client.server_count() == 0);
    let unsent = client.send(client.loan(0).unwrap()).unwrap_err();
    assert!(matches!(unsent.error, ServiceError::NoServer { .. }), "{unsent}");
}

#[test]
fn a_client_that_waits_and_cannot_be_reached_is_not_taken_for_gone() {
    let number = domain(64);
    clean(number);
    let participant = Participant::new(number).unwrap();
    // One that can answer, so that it is asked at all.
    let silent = server(&participant, "/crowded");
    let mut part = Part::start("server without memory", number);
    assert_eq!(part.hear(), "serves");
    let client = client(&participant, "/crowded");
    assert_eq!(client.server_count(), 1, "the other one cannot answer");
    let mut first = ask(&client, b"first");
    drop(take(&silent));
    assert_eq!(part.hear(), "answered");
    wait_for("the answer", || {
        (&mut first).now_or_never().is_some_and(|answer| answer.unwrap().body() == b"answer")
    });
    wait_for("the server that can answer by now", || client.server_count() == 2);
    let mut second = ask(&client, b"second");
    wait_for("the answer", || {
        (&mut second).now_or_never().is_some_and(|answer| answer.unwrap().body() == b"answer")
    });
    let request = take(&silent);
    drop((client, first, second));
    let error = silent.loan(RequestId::of(request.info()), 0).unwrap_err();
    assert!(matches!(error, ServiceError::ClientGone { .. }), "{error}");
    assert!(part.end().success());
}

/// Also when it takes nothing, and loses the oldest: nobody waits for it, and it counts them.
#[test]
fn who_looks_on_sees_requests_and_responses_of_all_and_disturbs_nobody() {
    let [robot, tool] = [(); 2].map(|()| Participant::new(domain(57)).unwrap());
    let [one, other] = [client(&robot, "/seen"), client(&robot, "/seen")];
    let server = server(&robot, "/seen");
    wait_for("the server", || [&one, &other].iter().all(|client| client.server_count() == 1));
    let before = robot.graph().unwrap();
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    let observe = |depth| tool.create_service_observer("/seen", &service_type, depth, Limits::default());
    let [requests, responses] = observe(4).unwrap();
    let after = robot.graph().unwrap();
    assert_eq!(before.services, after.services, "nobody sees it");
    assert_eq!(before.endpoints, after.endpoints, "nobody sees it");
    assert_eq!((server.client_count(), one.server_count()), (2, 1));
    assert_eq!((requests.publisher_count(), responses.publisher_count()), (2, 1));
    let seen = |observer: &RawSubscription| -> Vec<_> {
        let next = || observer.try_take().unwrap();
        let told = |sample: RawSample| (RequestId::of(sample.info()), sample.body().to_vec());
        std::iter::from_fn(next).filter(RawSample::is_message).map(told).collect()
    };
    let id = |client: &RawClient, sequence_number| RequestId { client: client.gid(), sequence_number };
    let call = |client: &RawClient, body: &[u8]| {
        let pending = ask(client, body);
        let request = take(&server);
        respond(&server, &request, &[request.body(), b"!"].concat());
        drop(request);
        assert_eq!(pending.now_or_never().unwrap().unwrap().body(), [body, b"!"].concat());
    };
    // Numbers of the clients that skip and come back are no losses.
    for (client, body) in [(&one, b"a"), (&one, b"b"), (&other, b"c"), (&one, b"d")] {
        call(client, body);
    }
    let of = |body: &[u8]| body.to_vec();
    let mut asked = seen(&requests);
    asked.sort_by_key(|(_, body)| body.clone());
    let expected = [(id(&one, 1), of(b"a")), (id(&one, 2), of(b"b")), (id(&other, 1), of(b"c"))];
    assert_eq!(asked[..3], expected);
    assert_eq!(asked[3], (id(&one, 3), of(b"d")));
    let answered = seen(&responses);
    let ids = [id(&one, 1), id(&one, 2), id(&other, 1), id(&one, 3)];
    assert_eq!(answered.iter().map(|(id, _)| *id).collect::<Vec<_>>(), ids);
    assert_eq!(answered[2].1, b"c!");
    // More than its queues have room for.
    for n in 0..100_u8 {
        call([&one, &other][usize::from(n % 2)], &[n]);
    }
    assert_eq!(seen(&requests).len(), 8, "4 of each client");
    let last = seen(&responses);
    assert_eq!(last.iter().map(|(_, body)| body[0]).collect::<Vec<_>>(), [96, 97, 98, 99]);
    assert_eq!((requests.counters().lost(), responses.counters().lost()), (92, 96));
    assert_eq!(responses.counters().received(), 8);
    // That there is no answer is no message.
    let pending = ask(&one, b"nobody");
    server.refuse(RequestId::of(take(&server).info())).unwrap();
    assert!(matches!(pending.now_or_never().unwrap(), Err(ServiceError::ServerGone { .. })));
    assert!(seen(&responses).is_empty());
    drop((requests, responses));
    call(&one, b"after");
}

#[test]
fn clients_come_and_go() {
    let participant = Participant::new(domain(63)).unwrap();
    let server = server(&participant, "/visited");
    for _ in 0..3 {
        let clients: Vec<_> = (0..4).map(|_| client(&participant, "/visited")).collect();
        assert_eq!(server.client_count(), 4);
        assert!(clients.iter().all(|client| server.can_answer(client.gid())));
        drop(clients);
        assert_eq!(server.client_count(), 0);
    }
    // One that asks before the server has looked for it.
    let client = client(&participant, "/visited");
    let pending = ask(&client, b"?");
    let request = take(&server);
    respond(&server, &request, b"!");
    assert_eq!(pending.now_or_never().unwrap().unwrap().body(), b"!");
}

#[test]
fn a_request_that_is_refused_has_no_answer_and_others_have_theirs() {
    let participant = Participant::new(domain(63)).unwrap();
    let server = server(&participant, "/refusing");
    let client = client(&participant, "/refusing");
    let [refused, answered] = [(); 2].map(|()| ask(&client, b"?"));
    let [first, second] = [(); 2].map(|()| take(&server));
    server.refuse(RequestId::of(first.info())).unwrap();
    respond(&server, &second, b"!");
    assert_eq!(answered.now_or_never().unwrap().unwrap().body(), b"!");
    let error = refused.now_or_never().unwrap().unwrap_err();
    assert!(matches!(error, ServiceError::ServerGone { .. }), "{error}");
    // Too late, and nobody's.
    server.refuse(RequestId::of(second.info())).unwrap();
    drop(client);
    assert_eq!(server.client_count(), 0);
    let error = server.refuse(RequestId::of(first.info())).unwrap_err();
    assert!(matches!(error, ServiceError::ClientGone { .. }), "{error}");
}

#[test]
fn a_request_that_is_none_of_its_type_is_refused_and_what_follows_is_served() {
    use tautline_ros_msgs::std_srvs::srv::SetBool;
    let participant = Participant::new(domain(63)).unwrap();
    let server = participant.create_server::<SetBool::Service>("/typed", 10, Limits::default()).unwrap();
    let client = participant
        .create_raw_client("/typed", &ServiceType::of::<SetBool::Service>(), Limits::default())
        .unwrap();
    let [invalid, empty, good] = [&[7_u8][..], &[], &[1]].map(|body| ask(&client, body));
    let request = wait_for_some("a request", || server.try_take().unwrap());
    assert!(request.data);
    server.respond(request.id(), &SetBool::Response { success: true, message: "done".into() }).unwrap();
    assert!(good.now_or_never().unwrap().is_ok());
    for invalid in [invalid, empty] {
        let error = invalid.now_or_never().unwrap().unwrap_err();
        assert!(matches!(error, ServiceError::ServerGone { .. }), "{error}");
    }
    assert_eq!(server.requests().counters().invalid(), 2);
}

#[test]
fn a_wait_for_a_server_ends_with_the_clients_node() {
    let participant = Participant::new(domain(63)).unwrap();
    let node = participant.create_node("waits", "/").unwrap();
    let client = client(&participant.for_node(&node), "/nobody");
    let mut wait = client.availability().unwrap();
    assert!((&mut wait).now_or_never().is_none());
    node.end();
    let error = wait.now_or_never().unwrap().unwrap_err();
    assert!(error.to_string().contains("node"), "{error}");
}

/// As many responses as can be held, and a request whose response waits for a place.
fn hoard(client: &RawClient, server: &RawServer) -> (Vec<RawSample>, RawPending) {
    let mut held = Vec::new();
    loop {
        let mut pending = ask(client, b"?");
        let request = take(server);
        respond(server, &request, b"!");
        match (&mut pending).now_or_never() {
            Some(response) => held.push(response.unwrap()),
            None => return (held, pending),
        }
    }
}

#[test]
fn an_answer_that_has_no_place_yet_is_waited_for_though_its_server_has_gone() {
    let participant = Participant::new(domain(63)).unwrap();
    let server = server(&participant, "/hoarding");
    let client = client(&participant, "/hoarding");
    let (mut held, mut pending) = hoard(&client, &server);
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

#[test]
fn a_request_ends_with_its_server_though_no_more_responses_can_be_held() {
    let participant = Participant::new(domain(54)).unwrap();
    let server = server(&participant, "/hoarded");
    let client = client(&participant, "/hoarded");
    let (mut held, pending) = hoard(&client, &server);
    held.pop();
    held.push(pending.now_or_never().unwrap().unwrap());
    let mut last = ask(&client, b"?");
    assert!((&mut last).now_or_never().is_none());
    drop(server);
    assert!(matches!(last.now_or_never(), Some(Err(ServiceError::ServerGone { .. }))));
}

#[test]
fn what_no_service_can_be_called_is_refused() {
    let participant = Participant::new(domain(63)).unwrap();
    let bytes = ServiceType::new("test_srvs/srv/Bytes", None);
    let (untyped, wrong) = (ServiceType::new("", None), ServiceType::new("test_srvs/srv/Bytes", Some("x")));
    let is_name = |error: &TransportError| matches!(error, TransportError::ServiceName { .. });
    let is_type = |error: &TransportError| matches!(error, TransportError::TopicType { .. });
    let create = |name: &str, service_type: &ServiceType| {
        let client = participant.create_raw_client(name, service_type, Limits::default());
        let server = participant.create_raw_server(name, service_type, 10, Limits::default());
        [client.map(drop), server.map(drop)].map(Result::unwrap_err)
    };
    for name in ["add", "/a b", "/add/", "", "/x:y", "/\u{1b}[2J"] {
        let errors = create(name, &bytes);
        assert!(errors.iter().all(is_name), "{name}: {errors:?}");
        assert!(errors.iter().all(|error| !error.to_string().contains('\u{1b}')), "{errors:?}");
    }
    for service_type in [&untyped, &wrong] {
        let errors = create("/refused", service_type);
        assert!(errors.iter().all(is_type), "{errors:?}");
    }
    assert!(participant.graph().unwrap().services.iter().all(|end| end.name != "/refused"));
}

/// More than a table of pending requests has room for, of two servers, one of which refuses; each response with its request's number.
#[test]
fn responses_are_taken_as_they_come_from_every_server() {
    let [here, there] = [(); 2].map(|()| Participant::new(domain(64)).unwrap());
    let service_type = ServiceType::new("test_srvs/srv/Bytes", None);
    let client = here.create_queued_client("/queued", &service_type, 200, Limits::default()).unwrap();
    let woken = Arc::new(AtomicUsize::new(0));
    client.wake_once(&Waker::from(Arc::new(Woken(woken.clone()))));
    let first = client.reserve();
    let unsent = client.send(first, client.loan(0).unwrap()).unwrap_err();
    assert!(matches!(unsent.error, ServiceError::NoServer { .. }));
    drop(unsent);
    let seat = here.doorbell().claim_sampler().unwrap();
    let service = || there.create_raw_server("/queued", &service_type, 200, Limits::default()).unwrap();
    let servers = [service(), service()];
    wait_for("both servers", || {
        seat.drain(|_| {});
        client.server_count() == 2
    });
    assert!(woken.load(Ordering::Relaxed) > 0, "it was told of a server");
    let ask = |number, body: &[u8]| {
        let mut loan = client.loan(body.len()).unwrap();
        loan.copy_from_slice(body);
        client.send(number, loan).unwrap();
    };
    ask(first, &[0]);
    (1..150).for_each(|n| ask(client.reserve(), &[n]));
    for (place, server) in servers.iter().enumerate() {
        for n in 0..150 {
            let request = take(server);
            assert_eq!((request.body(), request.info().sequence_number), (&[n][..], first + u64::from(n)));
            match place {
                0 => respond(server, &request, &[n, 7]),
                _ => server.refuse(RequestId::of(request.info())).unwrap(),
            }
        }
    }
    for n in 0..150 {
        let response = wait_for_some("a response", || client.try_take().unwrap());
        assert_eq!((response.body(), response.info().sequence_number), (&[n, 7][..], first + u64::from(n)));
    }
    assert!(client.try_take().unwrap().is_none(), "what was refused is passed over");
    drop(servers);
    wait_for("their ends", || client.server_count() == 0);
}

struct Woken(Arc<AtomicUsize>);

impl Wake for Woken {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}
