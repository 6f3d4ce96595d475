// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a node sees of others, under the names they have after remapping, and how it waits for them.

mod common;

use common::{Number, context};
use futures::executor::block_on;
use futures::{FutureExt, StreamExt};
use std::collections::HashMap;
use tautline::{
    Context, History, LoanError, Node, NodeOptions, PublishError, Qos, Realtime, RemapRules, Service,
};
use tautline_transport::Participant;

/// A service of whatever type.
struct Turn;

impl Service for Turn {
    type Request = Number;
    type Response = Number;
    type Event = Number;
    const TYPE_NAME: &'static str = "a_msgs/action/Turn_SendGoal";
    const TYPE_HASH: &'static str = "RIHS01_0000000000000000000000000000000000000000000000000000000000000000";
}

struct Add;

impl Service for Add {
    type Request = Number;
    type Response = Number;
    type Event = Number;
    const TYPE_NAME: &'static str = "a_msgs/srv/Add";
    const TYPE_HASH: &'static str = "RIHS01_0000000000000000000000000000000000000000000000000000000000000001";
}

fn map(pairs: &[(&str, &str)]) -> HashMap<String, Vec<String>> {
    pairs.iter().map(|(name, of_type)| ((*name).into(), vec![(*of_type).into()])).collect()
}

#[test]
fn a_node_sees_what_others_have() {
    common::isolate();
    let args = ["--ros-args", "--enclave", "/front"];
    let ctx = Context::builder().domain(109).realtime(Realtime::Off).args(args).build().unwrap();
    let mut talker = Node::create(ctx.clone(), "talker", "/robot").unwrap();
    let mut listener = Node::create(ctx, "listener", "").unwrap();
    let qos = Qos::keep_last(7).best_effort().transient_local();
    let publisher = talker.create_publisher::<Number>("count", qos).unwrap();
    let _subscription = listener.subscribe::<Number>("/robot/count", Qos::default()).unwrap();
    let service = "/robot/turn/_action/send_goal";
    let _turn = talker.create_service::<Turn>(service, qos).unwrap();
    let _add = talker.create_service::<Add>("add", qos).unwrap();
    let _client = listener.create_client::<Add>("/robot/add").unwrap();
    let _other = listener.create_client::<Add>("/nobody").unwrap();

    assert_eq!(listener.get_node_names().unwrap(), ["/listener", "/robot/talker"]);
    let graph = AsRef::<Participant>::as_ref(talker.context()).graph().unwrap();
    assert!(graph.nodes.iter().all(|node| node.enclave == "/front"));
    let pair = |name: &str, namespace: &str| (name.to_owned(), namespace.to_owned());
    assert_eq!(
        listener.get_node_names_and_namespaces().unwrap(),
        [pair("listener", "/"), pair("talker", "/robot")]
    );
    let topics = map(&[("/robot/count", "test_msgs/msg/Number")]);
    assert_eq!(listener.get_topic_names_and_types().unwrap(), topics);
    assert_eq!(listener.get_publisher_names_and_types_by_node("talker", "/robot").unwrap(), topics);
    assert!(listener.get_publisher_names_and_types_by_node("talker", "/").unwrap().is_empty());
    assert!(listener.get_subscriber_names_and_types_by_node("talker", "/robot").unwrap().is_empty());
    assert_eq!(listener.get_subscriber_names_and_types_by_node("listener", "/").unwrap(), topics);

    let [found] = &*talker.get_publishers_info_by_topic("count").unwrap() else { panic!("not one") };
    assert_eq!((&*found.node_name, &*found.node_namespace), ("talker", "/robot"));
    assert_eq!((&*found.topic_type, found.endpoint_gid), ("test_msgs/msg/Number", publisher.gid().0));
    assert_eq!((found.pid, found.is_remote), (Some(std::process::id()), false));
    let expected = Qos::keep_last(7).best_effort().transient_local();
    assert_eq!(found.qos, expected);
    let [found] = &*talker.get_subscriptions_info_by_topic("count").unwrap() else { panic!("not one") };
    assert_eq!((&*found.node_name, found.qos.history), ("listener", History::KeepLast));
    assert_eq!(
        (talker.count_publishers("count").unwrap(), talker.count_subscribers("count").unwrap()),
        (1, 1)
    );
    assert_eq!(listener.count_publishers("count").unwrap(), 0);

    let services = map(&[(service, "a_msgs/action/Turn_SendGoal"), ("/robot/add", "a_msgs/srv/Add")]);
    assert_eq!(listener.get_service_names_and_types().unwrap(), services);
    assert_eq!(listener.get_service_names_and_types_by_node("talker", "/robot").unwrap(), services);
    let clients = map(&[("/robot/add", "a_msgs/srv/Add"), ("/nobody", "a_msgs/srv/Add")]);
    assert_eq!(listener.get_client_names_and_types_by_node("listener", "/").unwrap(), clients);
    let actions = map(&[("/robot/turn", "a_msgs/action/Turn")]);
    assert_eq!(listener.get_action_names_and_types().unwrap(), actions);

    // It is there as long as a publisher of it, which sends nothing more.
    drop((talker, _turn, _add));
    assert_eq!(publisher.publish(&Number { value: 1 }), Err(PublishError::Loan(LoanError::Ended)));
    assert_eq!(listener.get_node_names().unwrap(), ["/listener", "/robot/talker"]);
    drop(publisher);
    assert_eq!(listener.get_node_names().unwrap(), ["/listener"]);
}

#[test]
fn a_node_waits_for_others() {
    let node = Node::create(context(110), "waits", "").unwrap();
    let there = node.wait_for_node("/robot/comes").unwrap();
    let publishers = node.wait_for_publishers("/robot/count", 2).unwrap();
    let subscribers = node.wait_for_subscribers("/robot/count", 1).unwrap();
    let service = node.wait_for_service("/robot/add").unwrap();
    let mut all = Box::pin(async { futures::try_join!(there, publishers, subscribers, service).unwrap() });
    assert!((&mut all).now_or_never().is_none());

    let comes = std::thread::spawn(|| {
        let mut node = Node::create(context(110), "comes", "/robot").unwrap();
        let publishers = [(); 2].map(|()| node.create_publisher::<Number>("count", Qos::default()).unwrap());
        let subscription = node.subscribe::<Number>("count", Qos::default()).unwrap();
        let service = node.create_service::<Add>("/robot/add", Qos::default()).unwrap();
        (node, publishers, subscription, service)
    });
    block_on(all);
    let mut events = node.graph_events().unwrap();
    drop(comes.join().unwrap());
    while node.get_node_names().unwrap().len() > 1 {
        block_on(events.next()).unwrap();
    }
}

#[test]
fn nodes_are_remapped_from_end_to_end() {
    let rules = RemapRules::parse(&["__ns:=/robot", "first:__node:=renamed", "count:=/all/count"]).unwrap();
    let ctx = Context::builder().domain(111).realtime(Realtime::Off).remap(rules).build().unwrap();
    let mut first = Node::create(ctx.clone(), "first", "/ignored").unwrap();
    assert_eq!(first.fully_qualified_name(), "/robot/renamed");
    let publisher = first.create_publisher::<Number>("count", Qos::default()).unwrap();
    assert_eq!(publisher.topic(), "/all/count");

    let own = NodeOptions::default().remap(RemapRules::parse(&["count:=~/count"]).unwrap());
    let mut second = Node::create_with_options(ctx.clone(), "second", "", own.clone()).unwrap();
    let publisher = second.create_publisher::<Number>("count", Qos::default()).unwrap();
    assert_eq!(publisher.topic(), "/robot/second/count");
    assert_eq!(second.get_node_names().unwrap(), ["/robot/renamed", "/robot/second"]);

    let alone = Node::create_with_options(ctx, "first", "", own.use_global_arguments(false)).unwrap();
    assert_eq!(alone.resolve_topic_name("count").unwrap(), "/first/count");
    assert_eq!(alone.expand_topic_name("count").unwrap(), "/count");
    assert_eq!(alone.resolve_service_name("count").unwrap(), "/first/count");
    assert_eq!(alone.get_node_names().unwrap(), ["/first", "/robot/renamed", "/robot/second"]);
}
