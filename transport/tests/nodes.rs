// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes, whose publishers and subscriptions are whose, services: in other processes, after a kill, from other hosts.

mod support;

use futures::{FutureExt, StreamExt};
use std::collections::HashSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, Waker};
use std::time::Duration;
use support::{
    Count, Part, clean, domain, participants, publisher, say, subscription, wait_for, wait_for_the_end,
};
use tautline_transport::{
    EndpointKind, Gid, GraphSnapshot, Limits, NodeInfo, NodeName, Origin, Participant, Publisher, Qos, Rank,
    RawClient, RawServer, RemoteGraph, RemoteNode, ServiceEndpoint, ServiceKind, ServiceType, TopicEndpoint,
    TopicType, TransportError, graph_of,
};

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    match part.as_str() {
        "node" => {
            let node = participant.create_node("child", "/robot").unwrap();
            let of_node = participant.for_node(&node);
            let _publisher = publisher(&of_node, "/count", Qos::keep_last(7).best_effort());
            let _server = server(&of_node, None);
            say("ready");
            wait_for_the_end();
        }
        "busy" => {
            let _node = participant.create_node("busy", "/").unwrap();
            say("ready");
            let parent = rustix::process::getppid();
            while rustix::process::getppid() == parent {
                let node = participant.create_node("coming", "/").unwrap();
                let _publisher = publisher(&participant.for_node(&node), "/coming", Qos::default());
            }
        }
        other => panic!("no part {other}"),
    }
}

fn server(participant: &Participant, hash: Option<&str>) -> RawServer {
    let service_type = ServiceType::new("a_msgs/srv/Add", hash);
    participant.create_raw_server("/robot/add", &service_type, 10, Limits::default()).unwrap()
}

fn client(participant: &Participant, hash: Option<&str>) -> RawClient {
    let service_type = ServiceType::new("a_msgs/srv/Add", hash);
    participant.create_raw_client("/robot/add", &service_type, Limits::default()).unwrap()
}

fn nodes(participant: &Participant) -> Vec<NodeInfo> {
    participant.graph().unwrap().nodes.iter().map(|node| (**node).clone()).collect()
}

fn name(namespace: &str, name: &str) -> NodeName {
    NodeName { namespace: namespace.into(), name: name.into() }
}

fn names(graph: &GraphSnapshot) -> Vec<String> {
    graph.nodes.iter().map(|node| node.name.full_name()).collect()
}

#[test]
fn nodes_and_what_is_theirs_are_seen_until_they_end() {
    let domain = domain(102);
    clean(domain);
    let participant = Participant::new(domain).unwrap();
    let observer = Participant::new(domain).unwrap();
    assert!(nodes(&observer).is_empty());

    let epoch = observer.graph_epoch();
    let node = participant.create_node_in_enclave("listener", "/robot", "/front").unwrap();
    assert_ne!(observer.graph_epoch(), epoch);
    let listed = nodes(&observer);
    let [me] = listed.as_slice() else { panic!("{listed:?}") };
    let process = Some(std::process::id());
    assert_eq!((&me.name, me.pid, me.is_remote), (&name("/robot", "listener"), process, false));
    assert_eq!(me.enclave, "/front");
    assert!(observer.graph().unwrap().endpoints.is_empty());

    let of_node = participant.for_node(&node);
    let subscription = subscription(&of_node, "/count", Qos::keep_last(3));
    let loose = publisher(&participant, "/count", Qos::default());
    let graph = observer.graph().unwrap();
    let [publisher, found] = graph.endpoints.as_slice() else { panic!("{graph:?}") };
    assert_eq!(
        (publisher.kind, &publisher.node, publisher.gid),
        (EndpointKind::Publisher, &None, loose.gid())
    );
    assert_eq!(
        (found.kind, found.node.as_ref(), &*found.topic, &*found.topic_type.name, found.qos),
        (EndpointKind::Subscription, Some(node.name()), "/count", "test_msgs/msg/Count", Qos::keep_last(3))
    );
    assert!(!found.is_own && participant.graph().unwrap().endpoints.iter().all(|end| end.is_own));

    let epoch = observer.graph_epoch();
    let hash = format!("RIHS01_{:064x}", 1);
    let server = server(&of_node, Some(&hash));
    let client = client(&of_node, Some(&hash));
    assert_ne!(observer.graph_epoch(), epoch);
    let graph = observer.graph().unwrap();
    assert_eq!(graph.endpoints.len(), 2, "how services are made of topics is nobody's business");
    let full_name = node.name().clone();
    let gids: HashSet<Gid> = graph.services.iter().map(|service| service.gid).collect();
    assert_eq!(gids.len(), 2);
    let expected = |kind| {
        let gid = graph.services[usize::from(kind == ServiceKind::Client)].gid;
        Arc::new(ServiceEndpoint {
            gid,
            kind,
            name: "/robot/add".into(),
            type_name: "a_msgs/srv/Add".into(),
            type_hash: Some(hash.clone()),
            node: Some(full_name.clone()),
            pid: Some(std::process::id()),
            is_remote: false,
            origin: Origin { tag: gid.tag(), ..Origin::default() },
            teller: None,
        })
    };
    assert_eq!(graph.services, [expected(ServiceKind::Server), expected(ServiceKind::Client)]);

    assert_eq!(graph.services[1].gid, client.gid());
    let service_type = observer.service_type("/robot/add").unwrap().unwrap();
    assert_eq!((&*service_type.name, service_type.hash.as_deref()), ("a_msgs/srv/Add", Some(hash.as_str())));

    // A node is there as long as something of it is.
    drop((node, of_node, server));
    let left = observer.graph().unwrap();
    assert_eq!(
        (names(&left), &left.services),
        (vec!["/robot/listener".into()], &vec![expected(ServiceKind::Client)])
    );
    drop(subscription);
    assert_eq!(nodes(&observer).len(), 1);
    let epoch = observer.graph_epoch();
    drop(client);
    assert_ne!(observer.graph_epoch(), epoch);
    assert!(nodes(&observer).is_empty() && observer.graph().unwrap().services.is_empty());
    drop((participant, loose));
    assert_eq!(participants(domain).len(), 1, "that of who observes");
}

#[test]
fn what_no_node_can_be_called_is_refused() {
    let participant = Participant::new(domain(103)).unwrap();
    for (namespace, name) in [("", "n"), ("/", ""), ("/", "a/b"), ("/x/", "n"), ("x", "n"), ("/", "a-b")] {
        let error = participant.create_node(name, namespace).unwrap_err();
        assert!(matches!(error, TransportError::NodeName { .. }), "{namespace} {name}: {error}");
    }
    let error = participant.create_node_in_enclave("n", "/", "front").unwrap_err();
    assert!(matches!(error, TransportError::Enclave { .. }), "{error}");
    assert!(participant.graph().unwrap().nodes.is_empty());
}

#[test]
fn nodes_of_a_killed_process_are_gone_and_those_of_others_stay() {
    let domain = domain(104);
    clean(domain);
    let participant = Participant::new(domain).unwrap();
    let _node = participant.create_node("here", "/").unwrap();
    let mut child = Part::start("node", domain);
    assert_eq!(child.hear(), "ready");
    let graph = participant.graph().unwrap();
    assert_eq!(names(&graph), ["/here", "/robot/child"]);
    assert!(graph.nodes[1].pid.is_some_and(|pid| pid != std::process::id()));
    let [publisher] = graph.endpoints.as_slice() else { panic!("{graph:?}") };
    assert_eq!(publisher.node, Some(name("/robot", "child")));
    assert_eq!(publisher.qos, Qos::keep_last(7).best_effort());
    assert_eq!((graph.services.len(), &graph.services[0].node), (1, &Some(name("/robot", "child"))));

    let mut events = participant.graph_events().unwrap();
    assert_eq!(participants(domain).len(), 2);
    child.kill();
    // The warden notices, and says so to those who wait; then all of it is gone at once.
    while names(&participant.graph().unwrap()) != ["/here"] {
        futures::executor::block_on(events.next()).unwrap();
    }
    let graph = participant.graph().unwrap();
    assert!(graph.endpoints.is_empty() && graph.services.is_empty(), "{graph:?}");
    wait_for("its file to be removed", || participants(domain).len() == 1);
}

#[test]
fn what_is_read_while_it_changes_is_whole() {
    let domain = domain(105);
    clean(domain);
    let participant = Participant::new(domain).unwrap();
    for _ in 0..5 {
        let mut child = Part::start("busy", domain);
        assert_eq!(child.hear(), "ready");
        let (mut with, mut without) = (0, 0);
        while with < 20 || without < 20 {
            let graph = participant.graph().unwrap();
            let coming = names(&graph).iter().filter(|name| *name == "/coming").count();
            assert_eq!(graph.nodes.len(), 1 + coming, "{graph:?}");
            *if coming == 0 { &mut without } else { &mut with } += 1;
            for end in &graph.endpoints {
                assert_eq!((end.topic.as_str(), &end.node), ("/coming", &Some(name("/", "coming"))));
            }
        }
        // Whatever it was writing.
        child.kill();
        wait_for("its end to be noticed", || nodes(&participant).is_empty());
    }
}

#[test]
fn events_come_for_every_change_and_end_with_the_participant() {
    let domain = domain(106);
    let participant = Participant::new(domain).unwrap();
    let other = Participant::new(domain).unwrap();
    let mut events = participant.graph_events().unwrap();
    // That the other one came is a change, too.
    while events.next().now_or_never().is_some() {}
    let changes = std::thread::spawn(move || {
        let node = other.create_node("n", "/").unwrap();
        let client = client(&other.for_node(&node), None);
        (other, node, client)
    });
    while participant.graph().unwrap().services.is_empty() {
        futures::executor::block_on(events.next()).unwrap();
    }
    drop(changes.join().unwrap());
    while !nodes(&participant).is_empty() {
        futures::executor::block_on(events.next()).unwrap();
    }
    drop(participant);
    futures::executor::block_on(async { while events.next().await.is_some() {} });
}

fn origin(gid: u8) -> Origin {
    Origin { tag: Gid([gid; 16]).tag(), ..Origin::default() }
}

fn remote_node(of: &str, gid: u8) -> RemoteNode {
    RemoteNode { name: name("/theirs", of), enclave: "/".into(), origin: origin(gid) }
}

/// Two ways lead to one end: a ring. It is listed as the shorter way tells of it, as the other once that one has gone.
#[test]
fn what_two_tell_of_is_listed_once() {
    let domain = domain(108);
    clean(domain);
    let [near, far, observer] = [(); 3].map(|()| Participant::new(domain).unwrap());
    assert!(near.domain_id() != 0 && near.domain_id() == observer.domain_id());
    let end = |gid, path: &[u64]| TopicEndpoint {
        kind: EndpointKind::Publisher,
        topic: "/ring".into(),
        topic_type: TopicType::new("std_msgs/msg/String"),
        gid: Gid([gid; 16]),
        qos: Qos::default(),
        node: Some(name("/theirs", "talker")),
        pid: None,
        is_remote: true,
        is_own: false,
        origin: Origin { path: path.to_vec(), ..origin(9) },
        teller: None,
    };
    let told = |gid, path: &[u64]| RemoteGraph {
        nodes: vec![RemoteNode {
            origin: Origin { path: path.to_vec(), ..origin(8) },
            ..remote_node("talker", 8)
        }],
        endpoints: vec![end(gid, path)],
        ..RemoteGraph::default()
    };
    far.set_remote(&told(1, &[70, 71])).unwrap();
    near.set_remote(&told(2, &[70])).unwrap();
    let listed = || {
        let graph = observer.graph().unwrap();
        let ends: Vec<_> = graph.endpoints.iter().map(|end| (end.gid.0[0], end.teller)).collect();
        let nodes: Vec<_> = graph.nodes.iter().map(|node| node.teller).collect();
        (ends, nodes)
    };
    assert_eq!(listed(), (vec![(2, Some(near.id()))], vec![Some(near.id())]));
    // Each of them sees what the other one tells, and nobody else has to.
    let rank = |of: &Participant| of.graph().unwrap().rivals.get(&origin(9).tag).copied();
    assert_eq!(rank(&near), Some(Rank { hops: 2, ros: 0, teller: far.id().into() }));
    assert_eq!(rank(&far), Some(Rank { hops: 1, ros: 0, teller: near.id().into() }));
    assert_eq!(rank(&observer), None);
    near.set_remote(&RemoteGraph::default()).unwrap();
    assert_eq!(listed(), (vec![(1, Some(far.id()))], vec![Some(far.id())]));
    near.set_remote(&told(2, &[70])).unwrap();
    assert_eq!(listed(), (vec![(2, Some(near.id()))], vec![Some(near.id())]));
    drop(near);
    assert_eq!(listed(), (vec![(1, Some(far.id()))], vec![Some(far.id())]));
}

/// Who tells other hosts of what is here knows which publishers have ended by themselves.
#[test]
fn who_tells_others_hears_what_has_ended() {
    let domain = domain(89);
    clean(domain);
    let [gateway, part] = [(); 2].map(|()| Participant::new(domain).unwrap());
    let publisher = |of: &Participant| publisher(of, "/x", Qos::default());
    let tag = |of: &Publisher<Count>| of.gid().tag();
    let (first, second) = (publisher(&part), publisher(&part));
    assert!(gateway.graph().unwrap().ended.is_empty());
    gateway.set_remote(&RemoteGraph::default()).unwrap();
    // How often that is said of the publisher with a tag.
    let said = |tag: u64| gateway.graph().unwrap().ended.iter().filter(|ended| **ended == tag).count();
    let tags = [tag(&first), tag(&second)];
    assert_eq!(said(tags[0]), 0);
    drop(first);
    assert_eq!(tags.map(said), [1, 0]);
    // Also if the record is written anew meanwhile, as it gets longer.
    (0..200).for_each(|_| drop(publisher(&part)));
    drop(second);
    assert_eq!(tags.map(said), [1, 1]);
    // And if its process ends at once.
    let last = publisher(&part);
    let tag_of_last = tag(&last);
    assert_eq!(said(tag_of_last), 0);
    drop((last, part));
    assert_eq!(said(tag_of_last), 1);
    // What others tell of counts as well, but not what this one itself tells.
    let other = Participant::new(domain).unwrap();
    other.set_remote(&RemoteGraph { ended: [7].into(), ..RemoteGraph::default() }).unwrap();
    gateway.set_remote(&RemoteGraph { ended: [8].into(), ..RemoteGraph::default() }).unwrap();
    assert_eq!([7, 8].map(said), [1, 0]);
}

/// More than a record has room for: what there is room for is announced, and a second attempt is no change, after which a relay would make
/// a third one.
#[test]
fn too_much_from_elsewhere_is_refused_without_a_change() {
    let domain = domain(100);
    clean(domain);
    let gateway = Participant::new(domain).unwrap();
    let end = |n: u64| {
        let mut gid = Gid::default();
        gid.0[..8].copy_from_slice(&(n + 1).to_le_bytes());
        TopicEndpoint {
            kind: EndpointKind::Publisher,
            topic: format!("/{n:0254}"),
            topic_type: TopicType::new("x".repeat(255)),
            gid,
            qos: Qos::default(),
            node: Some(name("/theirs", "talker")),
            pid: None,
            is_remote: true,
            is_own: false,
            origin: Origin { tag: n + 1, path: vec![u64::MAX; Origin::MOST_HOPS], ..Origin::default() },
            teller: None,
        }
    };
    let told = RemoteGraph { endpoints: (0..120_000).map(end).collect(), ..RemoteGraph::default() };
    gateway.set_remote(&told).unwrap_err();
    let epoch = gateway.graph_epoch();
    gateway.set_remote(&told).unwrap_err();
    assert_eq!(gateway.graph_epoch(), epoch);
    // What is left has room.
    let few = RemoteGraph { endpoints: (0..2).map(end).collect(), ..RemoteGraph::default() };
    gateway.set_remote(&few).unwrap();
    assert_eq!(gateway.graph().unwrap().endpoints.iter().filter(|end| end.is_remote).count(), 2);
}

#[test]
fn nodes_elsewhere_that_have_one_name_are_two() {
    let domain = domain(109);
    clean(domain);
    let [gateway, observer] = [(); 2].map(|()| Participant::new(domain).unwrap());
    let nodes = |gids: &[u8]| RemoteGraph {
        nodes: gids.iter().map(|gid| remote_node("twin", *gid)).collect(),
        ..RemoteGraph::default()
    };
    for (gids, listed) in [(&[1, 2][..], 2), (&[1, 2, 2], 2), (&[2], 1), (&[], 0)] {
        gateway.set_remote(&nodes(gids)).unwrap();
        assert_eq!(observer.graph().unwrap().nodes.len(), listed, "{gids:?}");
    }
}

#[test]
fn what_other_hosts_have_is_seen_beside_and_its_stand_ins_are_not() {
    let domain = domain(107);
    clean(domain);
    let gateway = Participant::new(domain).unwrap();
    let observer = Participant::new(domain).unwrap();
    gateway.set_remote(&RemoteGraph::default()).unwrap();
    let topic_type = TopicType::new("std_msgs/msg/String").with_hash(format!("RIHS01_{:064x}", 1));
    // For a publisher elsewhere.
    let _stand_in =
        gateway.create_raw_publisher("/chatter", &topic_type, Qos::default(), Limits::default()).unwrap();
    let node = observer.create_node("here", "/").unwrap();
    let _here = observer
        .for_node(&node)
        .create_raw_subscription("/chatter", &topic_type, Qos::default(), Limits::default())
        .unwrap();
    let deadline = Some(Duration::from_millis(5));
    let end = |topic: &str, kind, gid| TopicEndpoint {
        kind,
        topic: topic.into(),
        topic_type: topic_type.clone(),
        gid: Gid([gid; 16]),
        qos: Qos { deadline, ..Qos::keep_last(9).transient_local() },
        node: Some(name("/theirs", "talker")),
        pid: None,
        is_remote: true,
        is_own: false,
        origin: origin(gid),
        teller: Some(gateway.id()),
    };
    let service = ServiceEndpoint {
        kind: ServiceKind::Server,
        name: "/theirs/add".into(),
        type_name: "a/srv/B".into(),
        type_hash: None,
        gid: Gid([3; 16]),
        node: Some(name("/theirs", "talker")),
        pid: None,
        is_remote: true,
        origin: origin(3),
        teller: Some(gateway.id()),
    };
    let remote = RemoteGraph {
        nodes: vec![remote_node("silent", 4), remote_node("talker", 5)],
        endpoints: vec![
            end("/chatter", EndpointKind::Publisher, 1),
            end("/only_there", EndpointKind::Subscription, 2),
        ],
        services: vec![service.clone()],
        ..RemoteGraph::default()
    };
    let epoch = observer.graph_epoch();
    gateway.set_remote(&remote).unwrap();
    let after = observer.graph_epoch();
    assert_ne!(after, epoch);
    gateway.set_remote(&remote).unwrap();
    assert_eq!(observer.graph_epoch(), after, "nothing changed");

    let graph = observer.graph().unwrap();
    assert_eq!(names(&graph), ["/here", "/theirs/silent", "/theirs/talker"]);
    assert!(!graph.nodes[0].is_remote && graph.nodes[1].is_remote && graph.nodes[1].pid.is_none());
    let [there, here, only_there] = graph.endpoints.as_slice() else { panic!("{graph:?}") };
    assert_eq!((&**there, &**only_there), (&remote.endpoints[0], &remote.endpoints[1]));
    assert!(here.node.as_ref() == Some(node.name()) && !here.is_remote);
    assert_eq!(graph.services, [Arc::new(service)]);

    gateway.set_remote(&RemoteGraph::default()).unwrap();
    assert_eq!(names(&observer.graph().unwrap()), ["/here"]);
    gateway.set_remote(&remote).unwrap();
    let seen_from_outside = graph_of(domain).unwrap();
    assert_eq!(names(&seen_from_outside), ["/here", "/theirs/silent", "/theirs/talker"]);
    drop((gateway, _stand_in));
    assert_eq!(names(&observer.graph().unwrap()), ["/here"]);
}

/// What cannot be read does not hide what comes after it.
#[test]
fn a_stream_of_an_ended_node_gives_out_all_that_had_come() {
    use tautline_ros_msgs::std_srvs::srv::SetBool::Request;
    let participant = Participant::new(domain(103)).unwrap();
    let node = participant.create_node("ends", "/").unwrap();
    let qos = Qos::keep_last(50);
    let of_node = participant.for_node(&node);
    let mut stream = of_node.create_subscription::<Request>("/left", qos, Limits::default()).unwrap();
    let topic_type = TopicType::of::<Request>();
    let publisher = participant.create_raw_publisher("/left", &topic_type, qos, Limits::default()).unwrap();
    // More than are passed over in one poll.
    for body in [7; 40].into_iter().chain([1]) {
        publisher.publish(&[body]).unwrap();
    }
    node.end();
    let sample = futures::executor::block_on(stream.next()).expect("one is valid");
    assert!(sample.data);
    drop(sample);
    assert!(futures::executor::block_on(stream.next()).is_none());
}

#[test]
fn a_stream_of_an_ended_node_does_not_wait_for_what_comes_after_a_look() {
    const ROUNDS: usize = 300;
    let participant = Participant::new(domain(110)).unwrap();
    let (qos, limits) = (Qos::keep_last(4), Limits::default());
    let publisher = participant.create_publisher::<Count>("/goes_on", qos, limits).unwrap();
    let done = &AtomicBool::new(false);
    let mut context = Context::from_waker(Waker::noop());
    std::thread::scope(|scope| {
        scope.spawn(move || {
            while !done.load(Ordering::Relaxed) {
                publisher.publish(&Count { n: 1 }).unwrap();
                (0..100).for_each(|_| std::hint::spin_loop());
            }
        });
        let waits = |_| {
            let node = participant.create_node("ends", "/").unwrap();
            let of_node = participant.for_node(&node);
            let mut stream = of_node.create_subscription::<Count>("/goes_on", qos, limits).unwrap();
            node.end();
            // As if its thread was woken for the last time: no sampler drains the doorbell any more.
            while let Poll::Ready(sample) = stream.poll_next_unpin(&mut context) {
                if sample.is_none() {
                    return false;
                }
            }
            true
        };
        let waiting = (0..ROUNDS).map(waits).filter(|waits| *waits).count();
        done.store(true, Ordering::Relaxed);
        assert_eq!(waiting, 0, "of {ROUNDS} ended streams");
    });
}
