// SPDX-License-Identifier: MIT OR Apache-2.0
//! The mirror's control thread between a real domain and a far side that this test plays.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, mpsc};
use std::task::Waker;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tautline_relay::{
    Arrived, Delivery, Direction, EarlyLimits, Egress, Event, FarClient, FarGraph, FarServer, FarServices,
    FarSide, FarWriter, FoundType, InKey, Ingress, IngressUpdate, Inward, LocalGraph, MessageMeta,
    MirrorControl, OfferedService, Outbound, OutboundSample, Parts, Publisher, Relay, Report, Response, Rule,
    Rules, ServerId, Services, Side, SoughtService, TakenRequest, TopicKey, Transit, Writers,
};
use tautline_rt::ThreadBuilder;
use tautline_transport::{
    EndpointKind, Gid, Limits, NodeHandle, Origin, Participant, Qos, RawPublisher, RawSample,
    RawSubscription, RequestId, ServiceEndpoint, ServiceKind, ServiceType, TopicEndpoint, TopicType,
};

const DOMAIN: u32 = 94;
const HASH: &str = "RIHS01_1111111111111111111111111111111111111111111111111111111111111111";
const FAR: u128 = 9;

/// What the test has of the far side.
#[derive(Default)]
struct World {
    there: Vec<TopicEndpoint>,
    services: Vec<ServiceEndpoint>,
    ingresses: HashMap<InKey, Ingress>,
    /// Of how many publishers none passes the samples on yet.
    failing_senders: usize,
    /// Whether nothing more can begin to come in.
    is_full: bool,
    report: Option<Report>,
    notifier: Arc<Notifier>,
    requests: VecDeque<u32>,
    /// The least length of a request.
    request_bytes: usize,
    answers: Vec<Result<Vec<u8>, String>>,
    /// The nodes of the services that were offered, in order.
    offered: Vec<String>,
    /// Whether the thread that carries requests has ended: what takes samples is about to.
    is_ending: bool,
}

type Shared = Arc<Mutex<World>>;

fn of(shared: &Shared) -> MutexGuard<'_, World> {
    shared.lock().unwrap()
}

struct Log {
    passed: mpsc::Sender<Vec<u8>>,
    /// While it is locked nothing passes.
    gate: Arc<Mutex<()>>,
}

impl Egress for Log {
    type Key = TopicKey;
    type Topic = Outbound;
    type Sender = ();

    const EARLY: EarlyLimits = EarlyLimits { samples: 8, bytes: 1000, time: Duration::from_secs(2) };

    fn pass(&mut self, topic: &mut Outbound, (): &mut (), sample: OutboundSample) {
        drop(self.gate.lock().unwrap());
        topic.counters.passed(sample.body().len(), sample.info().source_timestamp_ns);
        let _ = self.passed.send(sample.body().to_vec());
    }

    fn dropped(topic: &Outbound) {
        topic.counters.dropped("early");
    }

    fn lost(topic: &Outbound, samples: u64) {
        topic.counters.lost(samples);
    }
}

struct ProxyPublisher;

impl FarWriter for ProxyPublisher {
    fn is_matched(&self) -> bool {
        true
    }
}

struct Play<const IS_ROS: bool>(Shared);

impl<const IS_ROS: bool> FarSide for Play<IS_ROS> {
    const SIDE: Side = if IS_ROS { Side::Ros } else { Side::Network };
    const DELIVERY: Delivery = Delivery { early: None, is_ordered: false };
    type Event = ();
    type Egress = Log;
    type Writer = ProxyPublisher;
    type Services = PlayServices;
    const PATIENCE: Option<Duration> = Some(Duration::from_secs(30));

    fn handle(&mut self, (): ()) -> bool {
        false
    }

    fn read_graph(&mut self, _: &LocalGraph) -> Result<FarGraph, String> {
        let endpoints = of(&self.0).there.clone();
        let mut publishers = HashMap::<String, BTreeSet<Gid>>::new();
        for end in endpoints.iter().filter(|end| end.kind == EndpointKind::Publisher) {
            publishers.entry(end.topic.clone()).or_default().insert(end.gid);
        }
        let endpoints = endpoints.into_iter().map(|end| (end, FAR)).collect();
        let services = of(&self.0).services.iter().map(|end| (end.clone(), FAR)).collect();
        Ok(FarGraph { endpoints, services, publishers, ..FarGraph::default() })
    }

    fn prepare(&mut self, _: &mut LocalGraph, _: &Transit) {}

    fn update_services(&mut self, _: &LocalGraph, _: &Transit) {}

    fn service_context(&self) {}

    fn announce(&mut self, _: &LocalGraph, _: &Transit, _: &Writers<ProxyPublisher>) {}

    fn tick(&mut self, _: &mut Writers<ProxyPublisher>) -> bool {
        true
    }

    fn find_type(&mut self, _: &TopicKey, _: Option<&str>) -> Result<FoundType, String> {
        Ok(FoundType { topic_type: topic_type(), schema: None })
    }

    fn open_writer(&mut self, _: &TopicKey, _: &Publisher) -> Result<ProxyPublisher, String> {
        Ok(ProxyPublisher)
    }

    fn sender(&mut self, _: &TopicKey, _: &ProxyPublisher) -> Result<(), String> {
        let failing = &mut of(&self.0).failing_senders;
        let left = failing.checked_sub(1);
        *failing = left.unwrap_or(0);
        left.map_or(Ok(()), |_| Err("not now".to_owned()))
    }

    fn start_in(&mut self, key: &InKey, _: &Inward, mut ingress: Ingress) -> Result<(), String> {
        let mut world = of(&self.0);
        if world.is_full {
            return Err("no room".to_owned());
        }
        if let Some(old) = world.ingresses.remove(key) {
            ingress.take_over(old, key.is_kept());
        }
        world.ingresses.insert(key.clone(), ingress);
        Ok(())
    }

    fn change_in(&mut self, key: &InKey, change: IngressUpdate) {
        if let Some(ingress) = of(&self.0).ingresses.get_mut(key) {
            ingress.change(change);
        }
    }

    fn stop_in(&mut self, key: &InKey) {
        of(&self.0).ingresses.remove(key);
    }

    fn report(&mut self, report: Report, _: &Writers<ProxyPublisher>) {
        of(&self.0).report = Some(report);
    }
}

/// Ends the wait of the thread that carries requests.
#[derive(Default)]
struct Notifier(Mutex<bool>, Condvar);

impl std::task::Wake for Notifier {
    fn wake(self: Arc<Self>) {
        *self.0.lock().unwrap() = true;
        self.1.notify_all();
    }
}

struct PlayServices(Shared);
struct Server(Shared);
struct Client;

impl Drop for PlayServices {
    fn drop(&mut self) {
        of(&self.0).is_ending = true;
    }
}

impl FarServices for PlayServices {
    type Server = Server;
    type Client = Client;
    type With = ();

    fn offer<'a>(
        &'a mut self,
        _: &'a TopicKey,
        service: &'a OfferedService,
        (): &'a (),
    ) -> Result<(ServiceType, Box<dyn FnOnce() -> Result<Server, String> + 'a>), String> {
        of(&self.0).offered.extend(service.node.as_ref().map(ToString::to_string));
        Ok((service_type(), Box::new(|| Ok(Server(self.0.clone())))))
    }

    fn seek(&mut self, _: &TopicKey, _: &SoughtService) -> Result<(ServiceType, Client), String> {
        Ok((service_type(), Client))
    }

    fn waker(&self) -> Waker {
        of(&self.0).notifier.clone().into()
    }

    fn wait(
        &mut self,
        servers: &[&Server],
        _: &[&Client],
        timeout: Option<Duration>,
    ) -> Result<Arrived, String> {
        let notifier = of(&self.0).notifier.clone();
        let has_requests = !of(&self.0).requests.is_empty();
        let rung = notifier.0.lock().unwrap();
        let timeout =
            if has_requests { Duration::ZERO } else { timeout.unwrap_or(Duration::from_secs(3600)) };
        let (mut rung, _) = notifier.1.wait_timeout_while(rung, timeout, |rung| !*rung).unwrap();
        *rung = false;
        Ok(Arrived { requests: vec![true; servers.len()], responses: Vec::new() })
    }
}

impl FarServer for Server {
    type Request = u32;

    fn take(&mut self) -> Option<TakenRequest<u32>> {
        let mut world = of(&self.0);
        let request = world.requests.pop_front()?;
        let mut body = request.to_le_bytes().to_vec();
        body.resize(body.len().max(world.request_bytes), 0);
        Some(Ok((request, body)))
    }

    fn answer(&mut self, _: u32, answer: Result<&[u8], &str>) -> Result<(), String> {
        of(&self.0).answers.push(answer.map(<[u8]>::to_vec).map_err(str::to_owned));
        Ok(())
    }
}

impl FarClient for Client {
    const IS_POLLED: bool = false;

    fn is_available(&mut self) -> bool {
        true
    }

    fn set_servers(&mut self, _: &BTreeSet<ServerId>) -> Vec<RequestId> {
        Vec::new()
    }

    fn make_room(&mut self, _: &dyn Fn(Gid) -> bool) -> (bool, Option<RequestId>) {
        (true, None)
    }

    fn send(&mut self, _: RequestId, _: &RawSample) -> Result<(), String> {
        Ok(())
    }

    fn take(&mut self) -> Option<Response> {
        None
    }

    fn forget(&mut self) -> usize {
        0
    }
}

struct Mirroring {
    world: Shared,
    passed: mpsc::Receiver<Vec<u8>>,
    gate: Arc<Mutex<()>>,
    events: mpsc::Sender<Event<()>>,
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

fn isolated() {
    tautline_rt::domain::test_scope(&format!("test{}", std::process::id()));
}

fn topic_type() -> TopicType {
    TopicType::new("test_msgs/msg/Bytes").with_hash(HASH)
}

fn service_type() -> ServiceType {
    ServiceType::new("test_msgs/srv/Bytes", Some(HASH))
}

fn end(kind: EndpointKind, topic: &str, id: u8, qos: Qos) -> TopicEndpoint {
    TopicEndpoint {
        kind,
        topic: topic.into(),
        topic_type: topic_type(),
        gid: Gid([id; 16]),
        qos,
        node: None,
        pid: None,
        is_remote: true,
        is_own: false,
        origin: Origin::here(Gid([id; 16]), "elsewhere"),
        teller: None,
    }
}

fn service_end(kind: ServiceKind, name: &str, id: u8) -> ServiceEndpoint {
    ServiceEndpoint {
        kind,
        name: name.into(),
        type_name: "test_msgs/srv/Bytes".into(),
        type_hash: Some(HASH.into()),
        gid: Gid([id; 16]),
        node: Some(tautline_transport::NodeName { namespace: "/".into(), name: "elsewhere".into() }),
        pid: None,
        is_remote: true,
        origin: Origin::here(Gid([id; 16]), "elsewhere"),
        teller: None,
    }
}

fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(60);
    while !is_so() {
        assert!(Instant::now() < end, "still waiting for: {what}");
        std::thread::yield_now();
    }
}

fn publish(publisher: &RawPublisher, body: &[u8]) {
    let mut loan = publisher.loan(body.len()).unwrap();
    loan.copy_from_slice(body);
    assert!(loan.publish().is_ok());
}

impl Mirroring {
    /// With these ends on the far side.
    fn start(domain: u32, there: Vec<TopicEndpoint>, change: impl FnOnce(&mut World)) -> Self {
        let service_rules = Rules { auto: true, ..Rules::default() };
        Self::start_as::<false>(domain, service_rules, |world| {
            world.there = there;
            change(world);
        })
    }

    fn start_as<const IS_ROS: bool>(
        domain: u32,
        service_rules: Rules,
        change: impl FnOnce(&mut World),
    ) -> Self {
        let participant = Participant::new(domain).unwrap();
        participant.set_remote(&Default::default()).unwrap();
        let (log, passed) = mpsc::channel();
        let gate = Arc::<Mutex<()>>::default();
        let mut world = World::default();
        change(&mut world);
        let world = Arc::new(Mutex::new(world));
        let egress = Log { passed: log, gate: gate.clone() };
        let relay = Relay::start(&participant, ThreadBuilder::new("relay"), egress).unwrap();
        let thread = ThreadBuilder::new("services");
        let services = Services::start(&participant, PlayServices(world.clone()), thread).unwrap();
        let transit = Transit::to_network(participant.domain_id(), participant.id(), 1, "host");
        let rules = Rules { auto: true, ..Rules::default() };
        let far = Play::<IS_ROS>(world.clone());
        let parts = Parts { participant, far, relay, services, transit, rules, service_rules };
        let (events, received) = mpsc::channel();
        let stop = Arc::<AtomicBool>::default();
        let thread = {
            let stop = stop.clone();
            std::thread::spawn(move || MirrorControl::new(parts).run(&received, &stop))
        };
        Mirroring { world, passed, gate, events, stop, thread }
    }

    fn world(&self) -> MutexGuard<'_, World> {
        of(&self.world)
    }

    /// There are these ends there now.
    fn there(&self, there: Vec<TopicEndpoint>) {
        self.world().there = there;
        self.events.send(Event::LocalChange).unwrap();
    }

    fn passed(&self) -> Vec<u8> {
        self.passed.recv_timeout(Duration::from_secs(60)).expect("waited in vain")
    }

    /// Somebody there published this.
    fn comes_in(&self, publisher: u8, number: u64, body: &[u8]) {
        let source = MessageMeta {
            publisher: Gid([publisher; 16]),
            number: Some(number),
            are_numbers_whole: true,
            timestamp_ns: 1,
        };
        self.world().ingresses.values_mut().next().unwrap().receive(body, source);
    }

    fn end(self) {
        self.stop.store(true, Ordering::Release);
        let _ = self.events.send(Event::Stop);
        self.thread.join().unwrap();
    }
}

/// More than may wait for a sender.
const MANY: u8 = 200;

#[test]
fn what_is_kept_finds_its_senders() {
    isolated();
    let participant = Participant::new(DOMAIN).unwrap();
    let qos = Qos::keep_last(MANY.into()).transient_local();
    let publisher = participant.create_raw_publisher("/x", &topic_type(), qos, Limits::default()).unwrap();
    (0..MANY).for_each(|n| publish(&publisher, &[n]));
    let mirroring = Mirroring::start(DOMAIN, Vec::new(), |_| {});
    assert_eq!(
        (0..MANY).map(|_| mirroring.passed()).collect::<Vec<_>>(),
        (0..MANY).map(|n| [n]).collect::<Vec<_>>()
    );
    mirroring.end();
}

#[test]
fn a_sender_that_cannot_be_made_is_tried_again() {
    isolated();
    const DOMAIN_HERE: u32 = DOMAIN + 1;
    let participant = Participant::new(DOMAIN_HERE).unwrap();
    let qos = Qos::keep_last(10);
    let publisher = participant.create_raw_publisher("/x", &topic_type(), qos, Limits::default()).unwrap();
    let reader = end(EndpointKind::Subscription, "/x", 7, qos);
    let mirroring = Mirroring::start(DOMAIN_HERE, vec![reader], |world| world.failing_senders = 2);
    until("a sample", || {
        publish(&publisher, &[1]);
        mirroring.passed.try_recv().is_ok()
    });
    assert_eq!(mirroring.world().failing_senders, 0);
    mirroring.end();
}

#[test]
fn what_was_published_last_goes_out() {
    isolated();
    const DOMAIN_HERE: u32 = DOMAIN + 2;
    let participant = Participant::new(DOMAIN_HERE).unwrap();
    let qos = Qos::keep_last(MANY.into());
    let publisher = participant.create_raw_publisher("/x", &topic_type(), qos, Limits::default()).unwrap();
    let mirroring =
        Mirroring::start(DOMAIN_HERE, vec![end(EndpointKind::Subscription, "/x", 7, qos)], |_| {});
    until("a sample", || {
        publish(&publisher, &[255]);
        mirroring.passed.try_recv().is_ok()
    });
    let gate = mirroring.gate.clone();
    let shut = gate.lock().unwrap();
    (0..MANY).for_each(|n| publish(&publisher, &[n]));
    mirroring.stop.store(true, Ordering::Release);
    mirroring.events.send(Event::Stop).unwrap();
    until("its end", || mirroring.world().is_ending);
    drop(shut);
    mirroring.thread.join().unwrap();
    let passed: Vec<Vec<u8>> = mirroring.passed.try_iter().filter(|body| *body != [255]).collect();
    assert_eq!(passed, (0..MANY).map(|n| [n]).collect::<Vec<_>>());
}

/// The port for late joiners cannot be made deeper; who listens goes on hearing, also those who come now.
#[test]
fn what_cannot_begin_anew_goes_on_with_new_publishers() {
    isolated();
    const DOMAIN_HERE: u32 = DOMAIN + 3;
    let participant = Participant::new(DOMAIN_HERE).unwrap();
    let kept = |depth| Qos::keep_last(depth).transient_local();
    let subscribe = |depth| -> RawSubscription {
        participant.create_raw_subscription("/x", &topic_type(), kept(depth), Limits::default()).unwrap()
    };
    let publisher = |id| end(EndpointKind::Publisher, "/x", id, kept(5));
    let heard = subscribe(5);
    let mirroring = Mirroring::start(DOMAIN_HERE, vec![publisher(7)], |_| {});
    until("a topic that comes in", || !mirroring.world().ingresses.is_empty());
    mirroring.comes_in(7, 1, &[1]);
    until("the first", || heard.try_take().unwrap().is_some_and(|sample| sample.body() == [1]));
    mirroring.world().is_full = true;
    let _deeper = subscribe(50);
    let is_told = |mirroring: &Mirroring| {
        mirroring.world().report.as_ref().is_some_and(|report| report.problems.contains_key("/x"))
    };
    until("the problem", || is_told(&mirroring));
    mirroring.there(vec![publisher(7), publisher(8)]);
    let mut number = 0;
    until("the new one", || {
        number += 1;
        mirroring.comes_in(8, number, &[2]);
        heard.try_take().unwrap().is_some_and(|sample| sample.body() == [2])
    });
    mirroring.world().is_full = false;
    until("no problem", || !is_told(&mirroring));
    mirroring.end();
}

#[test]
fn a_flood_of_events_keeps_nobody_from_ending() {
    isolated();
    let mirroring = Mirroring::start(DOMAIN + 4, Vec::new(), |_| {});
    let is_over = Arc::new(AtomicBool::new(false));
    let floods: Vec<_> = (0..2)
        .map(|_| {
            let (events, is_over) = (mirroring.events.clone(), is_over.clone());
            std::thread::spawn(move || {
                while !is_over.load(Ordering::Relaxed) && events.send(Event::FarChange(())).is_ok() {}
            })
        })
        .collect();
    until("numbers in the flood", || mirroring.world().report.is_some());
    mirroring.end();
    is_over.store(true, Ordering::Relaxed);
    floods.into_iter().for_each(|flood| flood.join().unwrap());
}

/// A client has 64 places, and one service of the domain is asked by all of the far side.
#[test]
fn more_requests_go_on_than_a_client_has_places() {
    isolated();
    const REQUESTS: u32 = 1024;
    const DOMAIN_HERE: u32 = DOMAIN + 5;
    let participant = Participant::new(DOMAIN_HERE).unwrap();
    let server =
        participant.create_raw_server("/s", &service_type(), REQUESTS as usize, Limits::default()).unwrap();
    let mirroring =
        Mirroring::start(DOMAIN_HERE, Vec::new(), |world| world.requests = (0..REQUESTS).collect());
    let mut taken = Vec::new();
    until("all requests", || {
        taken.extend(
            server
                .try_take()
                .unwrap()
                .map(|request| (RequestId::of(request.info()), request.body().to_vec())),
        );
        taken.len() == REQUESTS as usize
    });
    for (id, body) in &taken {
        let mut loan = server.loan(*id, body.len()).unwrap();
        loan.copy_from_slice(body);
        loan.send().map_err(|unsent| unsent.to_string()).unwrap();
    }
    until("all answers", || mirroring.world().answers.len() == REQUESTS as usize);
    let mut answers: Vec<u32> = (mirroring.world().answers.iter())
        .map(|answer| u32::from_le_bytes(answer.as_ref().unwrap()[..].try_into().unwrap()))
        .collect();
    answers.sort_unstable();
    assert_eq!(answers, (0..REQUESTS).collect::<Vec<_>>());
    mirroring.end();
}

#[test]
fn a_request_may_be_longer_than_all_that_may_wait() {
    isolated();
    const DOMAIN_HERE: u32 = DOMAIN + 6;
    const BYTES: usize = 17 << 20;
    let participant = Participant::new(DOMAIN_HERE).unwrap();
    let server = participant.create_raw_server("/s", &service_type(), 1, Limits::default()).unwrap();
    let mirroring = Mirroring::start(DOMAIN_HERE, Vec::new(), |world| {
        world.request_bytes = BYTES;
        world.requests.push_back(0);
    });
    let mut taken = None;
    until("the request", || {
        taken = server.try_take().unwrap();
        taken.is_some()
    });
    let request = taken.unwrap();
    assert_eq!(request.body().len(), BYTES);
    let response = server.loan(RequestId::of(request.info()), 0).unwrap();
    response.send().map_err(|unsent| unsent.to_string()).unwrap();
    until("the answer", || !mirroring.world().answers.is_empty());
    assert_eq!(mirroring.world().answers[0], Ok(Vec::new()));
    mirroring.end();
}

#[test]
fn services_of_the_far_side_are_announced_in_the_directions_of_their_rules() {
    isolated();
    const DOMAIN_HERE: u32 = DOMAIN + 7;
    let participant = Participant::new(DOMAIN_HERE).unwrap();
    let rule =
        |name: &str, direction| Rule { direction: Some(direction), ..Rule::new(name.parse().unwrap()) };
    let rules = vec![rule("/in", Direction::In), rule("/out", Direction::Out)];
    let rules = Rules { rules, ..Rules::default() };
    let mirroring = Mirroring::start_as::<false>(DOMAIN_HERE, rules, |world| {
        world.services = vec![
            service_end(ServiceKind::Server, "/in", 1),
            service_end(ServiceKind::Client, "/in", 2),
            service_end(ServiceKind::Server, "/out", 3),
            service_end(ServiceKind::Client, "/out", 4),
        ];
    });
    let mut announced = Vec::new();
    until("two ends", || {
        let graph = participant.graph().unwrap();
        let ends = graph.services.iter().filter(|end| end.teller.is_some());
        announced = ends.map(|end| (end.name.clone(), end.kind)).collect();
        announced.len() >= 2
    });
    announced.sort();
    let expected = [("/in", ServiceKind::Server), ("/out", ServiceKind::Client)];
    assert_eq!(announced, expected.map(|(name, kind)| (name.to_owned(), kind)));
    mirroring.end();
}

#[test]
fn a_service_follows_its_server_to_another_node() {
    isolated();
    const DOMAIN_HERE: u32 = DOMAIN + 8;
    let participant = Participant::new(DOMAIN_HERE).unwrap();
    let [first, second] = ["first", "second"].map(|name| participant.create_node(name, "/").unwrap());
    let serve = |node: &NodeHandle| {
        let participant = participant.for_node(node);
        participant.create_raw_server("/s", &service_type(), 1, Limits::default()).unwrap()
    };
    let server = serve(&first);
    let rules = Rules { auto: true, ..Rules::default() };
    let mirroring = Mirroring::start_as::<true>(DOMAIN_HERE, rules, |_| {});
    until("the first node's", || mirroring.world().offered == ["/first"]);
    let _next = serve(&second);
    drop(server);
    until("the second node's", || mirroring.world().offered == ["/first", "/second"]);
    mirroring.end();
}
