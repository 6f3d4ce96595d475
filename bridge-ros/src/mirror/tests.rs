// SPDX-License-Identifier: MIT OR Apache-2.0
use super::*;
use crate::rules::{QosOverride, Rule};
use tautline_transport::TopicType;

const STRING: &str = "std_msgs/msg/String";

fn end(kind: EndpointKind, topic: &str, id: u8, qos: Qos) -> TopicEndpoint {
    TopicEndpoint {
        kind,
        topic: topic.into(),
        topic_type: TopicType::new(STRING),
        gid: Gid([id; 16]),
        qos,
        node: None,
        pid: None,
        is_remote: false,
        is_own: false,
        origin: Default::default(),
        teller: None,
    }
}

fn publisher(topic: &str, id: u8) -> TopicEndpoint {
    end(EndpointKind::Publisher, topic, id, Qos::default())
}

fn subscription(topic: &str, id: u8) -> TopicEndpoint {
    end(EndpointKind::Subscription, topic, id, Qos::default())
}

fn auto() -> Mirror {
    Mirror::new(Rules { auto: true, ..Rules::default() })
}

fn ruled(rule: Rule) -> Mirror {
    Mirror::new(Rules { rules: vec![rule], ..Rules::default() })
}

fn rule(topic: &str) -> Rule {
    Rule::new(topic.parse().unwrap())
}

/// What is done, in short: `open /x 1`.
fn told(actions: &[Action]) -> Vec<String> {
    let class = |class: Class| match (class.is_reliable, class.is_kept) {
        (true, false) => "default",
        (true, true) => "latched",
        (false, false) => "best effort",
        (false, true) => "best effort, latched",
    };
    let ids = |gids: &BTreeSet<Gid>| gids.iter().map(|gid| gid.0[0]).collect::<Vec<_>>();
    let one = |action: &Action| match action {
        Action::OpenWriter(key, gid, ..) => format!("open {} {}", key.ros_topic, gid.0[0]),
        Action::CloseWriter(key, gid) => format!("close {} {}", key.ros_topic, gid.0[0]),
        Action::StartOut(key, out) => format!("take {} {}", key.topic, out.depth),
        Action::StopOut(key) => format!("stop {}", key.topic),
        Action::StartIn(key, now) => {
            format!("in {} {} {:?}", key.topic.ros_topic, class(key.class), ids(&now.publishers))
        }
        Action::ChangeIn(key, now) => {
            format!("change {} {} {:?}", key.topic.ros_topic, class(key.class), ids(&now.publishers))
        }
        Action::StopIn(key) => format!("end {} {}", key.topic.ros_topic, class(key.class)),
    };
    actions.iter().map(one).collect()
}

#[test]
fn to_ros_while_it_is_read_there() {
    let mut mirror = auto();
    let here = [publisher("/x", 1)];
    assert_eq!(told(&mirror.update(&here, &[])), ["open /x 1"], "seen in ROS, not taken");
    assert!(mirror.update(&here, &[publisher("/x", 9)]).is_empty());
    let there = [subscription("/x", 9)];
    assert_eq!(told(&mirror.update(&here, &there)), ["take /x 10"]);
    assert!(mirror.update(&here, &there).is_empty());
    let more = [publisher("/x", 1), end(EndpointKind::Publisher, "/x", 2, Qos::keep_last(500))];
    assert_eq!(told(&mirror.update(&more, &there)), ["open /x 2", "take /x 500"]);
    assert_eq!(told(&mirror.update(&here, &there)), ["close /x 2"], "the queue stays as long");
    assert_eq!(told(&mirror.update(&here, &[])), ["stop /x"]);
    assert_eq!(told(&mirror.update(&[], &there)), ["close /x 1"]);
}

#[test]
fn what_an_action_tells_goes_to_ros_before_anybody_is_seen_to_listen() {
    let here = [publisher("/dock/_action/feedback", 1)];
    let actions = auto().update(&here, &[]);
    assert_eq!(told(&actions), ["open /dock/_action/feedback 1", "take /dock/_action/feedback 10"]);
}

#[test]
fn publishers_keep_their_qos_but_for_what_nobody_can_keep() {
    let mut mirror = auto();
    let second = Some(Duration::from_secs(1));
    let qos = Qos {
        deadline: second,
        lifespan: second,
        liveliness: tautline_transport::Liveliness::ManualByTopic,
        liveliness_lease_duration: second,
        ..Qos::keep_last(3).transient_local().best_effort()
    };
    let actions = mirror.update(&[end(EndpointKind::Publisher, "/x", 1, qos)], &[]);
    let Action::OpenWriter(_, _, opened, _) = &actions[0] else { panic!("{actions:?}") };
    let kept =
        Qos { deadline: second, lifespan: second, ..Qos::keep_last(3).transient_local().best_effort() };
    assert_eq!(*opened, kept);
    // Another QoS is another publisher.
    let actions = mirror.update(&[publisher("/x", 1)], &[]);
    assert_eq!(told(&actions), ["close /x 1", "open /x 1"]);
}

#[test]
fn from_ros_by_what_publishers_offer() {
    let mut mirror = auto();
    let here = [subscription("/x", 1)];
    assert_eq!(told(&mirror.update(&here, &[])), ["in /x default []"], "seen in ROS");
    let there = [publisher("/x", 7), publisher("/x", 8)];
    assert_eq!(told(&mirror.update(&here, &there)), ["change /x default [7, 8]"]);
    let best_effort = end(EndpointKind::Publisher, "/x", 9, Qos::default().best_effort());
    let latched = end(EndpointKind::Publisher, "/x", 10, Qos::keep_last(1).transient_local());
    let mixed = [publisher("/x", 7), best_effort.clone(), latched];
    assert_eq!(
        told(&mirror.update(&here, &mixed)),
        ["in /x best effort [9]", "change /x default [7]", "in /x latched [10]"]
    );
    assert_eq!(told(&mirror.update(&here, &[best_effort])), ["end /x default", "end /x latched"]);
    assert_eq!(told(&mirror.update(&[], &there)), ["end /x best effort"]);
}

#[test]
fn who_wants_best_effort_alone_is_not_shown_before_somebody_sends() {
    let mut mirror = auto();
    let here = [end(EndpointKind::Subscription, "/x", 1, Qos::default().best_effort())];
    assert!(mirror.update(&here, &[]).is_empty());
    assert_eq!(told(&mirror.update(&here, &[publisher("/x", 7)])), ["in /x default [7]"]);
}

#[test]
fn queues_and_what_is_kept_are_as_deep_as_the_deepest_asks() {
    let mut mirror = auto();
    let here = [
        end(EndpointKind::Subscription, "/x", 1, Qos::keep_last(5000).transient_local()),
        subscription("/x", 2),
    ];
    let second = Some(Duration::from_secs(1));
    let offered = Qos { deadline: second, ..Qos::keep_last(10).transient_local() };
    let there =
        [end(EndpointKind::Publisher, "/x", 7, offered), end(EndpointKind::Publisher, "/x", 8, offered)];
    let actions = mirror.update(&here, &there);
    let Action::StartIn(_, inward) = &actions[0] else { panic!("{actions:?}") };
    assert_eq!((inward.qos.depth, inward.offered.depth), (5000, 8192));
    assert_eq!((inward.offered.durability, inward.offered.deadline), (Durability::TransientLocal, second));
    // The deadline of one that has none is kept by nobody.
    let actions = mirror.update(
        &here,
        &[there[0].clone(), end(EndpointKind::Publisher, "/x", 9, Qos::default().transient_local())],
    );
    let Action::StartIn(_, inward) = &actions[0] else { panic!("{actions:?}") };
    assert_eq!(inward.offered.deadline, None);
    // Of a class that keeps nothing.
    let actions = mirror.update(&[subscription("/y", 1)], &[publisher("/y", 7)]);
    let Some(Action::StartIn(_, inward)) = actions.last() else { panic!("{actions:?}") };
    assert_eq!((inward.qos.depth, inward.offered.depth), (MIN_DEPTH_IN, 1));
}

#[test]
fn a_few_latched_publishers_more_are_no_new_port() {
    let mut mirror = auto();
    let here = [end(EndpointKind::Subscription, "/x", 1, Qos::keep_last(1).transient_local())];
    let latched = |id| end(EndpointKind::Publisher, "/x", id, Qos::keep_last(10).transient_local());
    assert_eq!(told(&mirror.update(&here, &[latched(7)])), ["in /x latched [7]"]);
    let three = [latched(7), latched(8), latched(9)];
    assert_eq!(told(&mirror.update(&here, &three)), ["change /x latched [7, 8, 9]"]);
    let four = [latched(7), latched(8), latched(9), latched(10)];
    assert_eq!(told(&mirror.update(&here, &four)), ["in /x latched [7, 8, 9, 10]"], "it must keep more");
    assert_eq!(told(&mirror.update(&here, &three)), ["change /x latched [7, 8, 9]"]);
}

#[test]
fn what_failed_is_not_tried_again_after_what_came_later() {
    let mut mirror = auto();
    let here = [publisher("/x", 1), subscription("/x", 2)];
    let there = [publisher("/x", 7), subscription("/x", 8)];
    let begin = mirror.update(&here, &there);
    let [open, out, start] = begin.as_slice() else { panic!("{begin:?}") };
    let change = &mirror.update(&here, &[there[0].clone(), there[1].clone(), publisher("/x", 9)])[0];
    let ends = mirror.update(&[], &[]);
    let [stop_out, close, stop_in] = ends.as_slice() else { panic!("{ends:?}") };
    let all = [open, out, start, change, stop_out, close, stop_in];
    let replaced = |action: &Action| {
        told(&all.map(Action::clone).into_iter().filter(|failed| action.replaces(failed)).collect::<Vec<_>>())
    };
    assert_eq!(replaced(open), ["open /x 1"]);
    assert_eq!(replaced(close), ["open /x 1"]);
    assert_eq!(replaced(out), ["take /x 10"]);
    assert_eq!(replaced(stop_out), ["take /x 10"]);
    // A change of what could not be begun is that beginning's.
    assert_eq!(replaced(change), ["change /x default [7, 9]"]);
    assert_eq!(replaced(start), ["in /x default [7]", "change /x default [7, 9]"]);
    assert_eq!(replaced(stop_in), ["in /x default [7]", "change /x default [7, 9]"]);
}

#[test]
fn what_rules_say() {
    let (here, there) =
        ([publisher("/x", 1), subscription("/x", 2)], [publisher("/y", 7), subscription("/y", 8)]);
    let mut renamed = ruled(Rule { ros_topic: Some("/y".parse().unwrap()), ..rule("/x") });
    assert_eq!(told(&renamed.update(&here, &there)), ["open /y 1", "take /x 10", "in /y default [7]"]);
    let one_way =
        |direction| Rule { direction: Some(direction), ros_topic: Some("/y".parse().unwrap()), ..rule("/x") };
    assert_eq!(told(&ruled(one_way(Direction::FromRos)).update(&here, &there)), ["in /y default [7]"]);
    assert_eq!(told(&ruled(one_way(Direction::ToRos)).update(&here, &there)), ["open /y 1", "take /x 10"]);
    assert!(ruled(rule("/z")).update(&here, &there).is_empty());

    let qos =
        QosOverride { reliability: Some(Reliability::BestEffort), depth: Some(3), ..QosOverride::default() };
    let mut weakened = ruled(Rule { qos, ..rule("/x") });
    let actions = weakened.update(&here, &[publisher("/x", 7)]);
    assert_eq!(told(&actions), ["open /x 1", "in /x best effort [7]"]);
    let (Action::OpenWriter(_, _, out, _), Action::StartIn(_, inward)) = (&actions[0], &actions[1]) else {
        panic!()
    };
    assert_eq!((*out, inward.qos), (Qos::keep_last(3).best_effort(), Qos::keep_last(3).best_effort()));
    let qos = QosOverride { durability: Some(Durability::TransientLocal), ..QosOverride::default() };
    let mut demanding = ruled(Rule { qos, ..rule("/x") });
    demanding.update(&here, &[publisher("/x", 7)]);
    assert!(demanding.problems()["/x"].contains("Durability"), "{:?}", demanding.problems());
}

#[test]
fn types_that_differ_are_told_and_the_rest_goes_on() {
    let typed =
        |end: TopicEndpoint, name: &'static str| TopicEndpoint { topic_type: TopicType::new(name), ..end };
    let hashed = |end: TopicEndpoint, digit: &str| {
        let topic_type = TopicType::new(STRING).with_hash(format!("RIHS01_{}", digit.repeat(64)));
        TopicEndpoint { topic_type, ..end }
    };
    let mut mirror = auto();
    let here = [subscription("/x", 1), subscription("/fine", 2)];
    let int = typed(publisher("/x", 7), "std_msgs/msg/Int32");
    let there = [int.clone(), publisher("/fine", 8)];
    let actions = told(&mirror.update(&here, &there));
    assert_eq!(actions, ["in /fine default [8]", "in /x default []"]);
    let said = &mirror.problems()["/x"];
    assert!(said.contains("std_msgs/msg/Int32") && said.contains(STRING), "{said}");
    // A topic with two types: the one that is the same.
    assert_eq!(
        told(&mirror.update(&here, &[int, publisher("/x", 9), publisher("/fine", 8)])),
        ["change /x default [9]"]
    );
    assert!(mirror.problems().is_empty());
    // The same name, defined differently.
    let mut mirror = auto();
    mirror.update(&[hashed(subscription("/x", 1), "1")], &[hashed(publisher("/x", 7), "2")]);
    assert!(mirror.problems()["/x"].contains("defined differently"), "{:?}", mirror.problems());
    // Of two types here the one that ROS has, and of two definitions of that.
    let mut mirror = auto();
    let int = |end| typed(end, "std_msgs/msg/Int32");
    let here = [hashed(publisher("/x", 1), "1"), hashed(publisher("/x", 2), "2"), int(publisher("/x", 3))];
    let there = [hashed(subscription("/x", 7), "2")];
    let actions = mirror.update(&here, &there);
    assert_eq!(told(&actions), ["open /x 2", "take /x 10"]);
    let Action::OpenWriter(_, _, _, Some(hash)) = &actions[0] else { panic!("{actions:?}") };
    assert!(hash.ends_with("2222") && mirror.problems().is_empty());
    let both = [there[0].clone(), int(subscription("/x", 8))];
    assert!(mirror.update(&here, &both).is_empty(), "it stays the same");
    assert!(mirror.problems()["/x"].contains("one type of a topic"), "{:?}", mirror.problems());
    let actions = mirror.update(&here, &both[1..]);
    assert_eq!(told(&actions), ["stop /x", "close /x 2", "open /x 3", "take /x 10"]);
    assert!(mirror.problems().is_empty());
    let mut expecting = ruled(Rule { type_name: Some("a/msg/B".into()), ..rule("/x") });
    assert!(expecting.update(&[subscription("/x", 1)], &[publisher("/x", 7)]).is_empty());
    assert!(expecting.problems()["/x"].contains("the configuration says a/msg/B"));
}
