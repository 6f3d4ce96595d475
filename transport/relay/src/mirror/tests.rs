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

/// The ROS graph, all of which comes in through this mirror.
impl Mirror {
    fn look(&mut self, here: &[TopicEndpoint], there: &[TopicEndpoint]) -> Vec<Action> {
        self.update(here, &there.iter().map(|end| (end, true)).collect::<Vec<_>>())
    }
}

fn auto() -> Mirror {
    Mirror::new(Side::Ros, Rules { auto: true, ..Rules::default() })
}

fn ruled(rule: Rule) -> Mirror {
    Mirror::new(Side::Ros, Rules { rules: vec![rule], ..Rules::default() })
}

fn rule(topic: &str) -> Rule {
    Rule::new(topic.parse().unwrap())
}

/// Actions in short: `open /x 1`.
fn told(actions: &[Action]) -> Vec<String> {
    let class = |class: Option<Class>| match class.map(|class| (class.is_reliable, class.is_kept)) {
        None => "all",
        Some((true, false)) => "default",
        Some((true, true)) => "latched",
        Some((false, false)) => "best effort",
        Some((false, true)) => "best effort, latched",
    };
    let ids = |now: &Inward| now.publishers.keys().map(|gid| gid.0[0]).collect::<Vec<_>>();
    let one = |action: &Action| match action {
        Action::OpenWriter(key, gid, ..) => format!("open {} {}", key.far_topic, gid.0[0]),
        Action::CloseWriter(key, gid) => format!("close {} {}", key.far_topic, gid.0[0]),
        Action::StartOut(key, out) => format!("take {} {}", key.topic, out.depth),
        Action::StopOut(key) => format!("stop {}", key.topic),
        Action::StartIn(key, now) => {
            format!("in {} {} {:?}", key.topic.far_topic, class(key.class), ids(now))
        }
        Action::ChangeIn(key, now) => {
            format!("change {} {} {:?}", key.topic.far_topic, class(key.class), ids(now))
        }
        Action::AskAgain(key, now) => {
            format!("again {} {} {:?}", key.topic.far_topic, class(key.class), ids(now))
        }
        Action::StopIn(key) => format!("end {} {}", key.topic.far_topic, class(key.class)),
    };
    actions.iter().map(one).collect()
}

#[test]
fn to_ros_while_it_is_read_there() {
    let mut mirror = auto();
    let here = [publisher("/x", 1)];
    assert_eq!(told(&mirror.look(&here, &[])), ["open /x 1"], "seen in ROS, not taken");
    assert!(mirror.look(&here, &[publisher("/x", 9)]).is_empty());
    let there = [subscription("/x", 9)];
    assert_eq!(told(&mirror.look(&here, &there)), ["take /x 10"]);
    assert!(mirror.look(&here, &there).is_empty());
    let more = [publisher("/x", 1), end(EndpointKind::Publisher, "/x", 2, Qos::keep_last(500))];
    assert_eq!(told(&mirror.look(&more, &there)), ["open /x 2", "take /x 500"]);
    assert_eq!(told(&mirror.look(&here, &there)), ["close /x 2"], "the queue stays as long");
    assert_eq!(told(&mirror.look(&here, &[])), ["stop /x"]);
    assert_eq!(told(&mirror.look(&[], &there)), ["close /x 1"]);
}

#[test]
fn what_an_action_tells_goes_to_ros_before_anybody_is_seen_to_listen() {
    let here = [publisher("/dock/_action/feedback", 1)];
    let actions = auto().look(&here, &[]);
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
    let actions = mirror.look(&[end(EndpointKind::Publisher, "/x", 1, qos)], &[]);
    let Action::OpenWriter(_, _, opened, _) = &actions[0] else { panic!("{actions:?}") };
    let kept =
        Qos { deadline: second, lifespan: second, ..Qos::keep_last(3).transient_local().best_effort() };
    assert_eq!(*opened, kept);
    // A changed QoS is a new publisher.
    let actions = mirror.look(&[publisher("/x", 1)], &[]);
    assert_eq!(told(&actions), ["close /x 1", "open /x 1"]);
}

#[test]
fn in_ros_no_writer_waits_for_its_readers_unless_a_rule_says_so() {
    let here = [end(EndpointKind::Publisher, "/x", 1, Qos::keep_all(7))];
    let opened = |mut mirror: Mirror| match &mirror.look(&here, &[])[..] {
        [Action::OpenWriter(_, _, qos, _)] => *qos,
        actions => panic!("{actions:?}"),
    };
    let rules = || Rules { auto: true, ..Rules::default() };
    assert_eq!(opened(Mirror::new(Side::Ros, rules())), Qos::keep_last(7));
    assert_eq!(opened(Mirror::new(Side::Network, rules())), Qos::keep_all(7));
    let qos = QosOverride { history: Some(History::KeepAll), ..QosOverride::default() };
    assert_eq!(opened(ruled(Rule { qos, ..rule("/x") })), Qos::keep_all(7));
}

#[test]
fn from_ros_by_what_publishers_offer() {
    let mut mirror = auto();
    let here = [subscription("/x", 1)];
    assert_eq!(told(&mirror.look(&here, &[])), ["in /x default []"], "seen in ROS");
    let there = [publisher("/x", 7), publisher("/x", 8)];
    assert_eq!(told(&mirror.look(&here, &there)), ["change /x default [7, 8]"]);
    let best_effort = end(EndpointKind::Publisher, "/x", 9, Qos::default().best_effort());
    let latched = end(EndpointKind::Publisher, "/x", 10, Qos::keep_last(1).transient_local());
    let mixed = [publisher("/x", 7), best_effort.clone(), latched];
    assert_eq!(
        told(&mirror.look(&here, &mixed)),
        ["in /x best effort [9]", "change /x default [7]", "in /x latched [10]"]
    );
    assert_eq!(told(&mirror.look(&here, &[best_effort])), ["end /x default", "end /x latched"]);
    assert_eq!(told(&mirror.look(&[], &there)), ["end /x best effort"]);
}

#[test]
fn who_wants_best_effort_alone_is_not_shown_before_somebody_sends() {
    let mut mirror = auto();
    let here = [end(EndpointKind::Subscription, "/x", 1, Qos::default().best_effort())];
    assert!(mirror.look(&here, &[]).is_empty());
    assert_eq!(told(&mirror.look(&here, &[publisher("/x", 7)])), ["in /x default [7]"]);
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
    let actions = mirror.look(&here, &there);
    let Action::StartIn(_, inward) = &actions[0] else { panic!("{actions:?}") };
    assert_eq!((inward.qos.depth, inward.offered.depth), (5000, 8192));
    assert_eq!((inward.offered.durability, inward.offered.deadline), (Durability::TransientLocal, second));
    // With a publisher without a deadline, none is offered.
    let actions = mirror.look(
        &here,
        &[there[0].clone(), end(EndpointKind::Publisher, "/x", 9, Qos::default().transient_local())],
    );
    let Action::StartIn(_, inward) = &actions[0] else { panic!("{actions:?}") };
    assert_eq!(inward.offered.deadline, None);
    // Nor without that publisher again: what is kept would come again.
    assert_eq!(told(&mirror.look(&here, &there)), ["change /x latched [7, 8]"]);
    // Of a volatile class.
    let actions = mirror.look(&[subscription("/y", 1)], &[publisher("/y", 7)]);
    let Some(Action::StartIn(_, inward)) = actions.last() else { panic!("{actions:?}") };
    assert_eq!((inward.qos.depth, inward.offered.depth), (MIN_DEPTH_IN, 1));
}

#[test]
fn a_few_latched_publishers_more_are_no_new_port() {
    let mut mirror = auto();
    let here = [end(EndpointKind::Subscription, "/x", 1, Qos::keep_last(1).transient_local())];
    let latched = |id| end(EndpointKind::Publisher, "/x", id, Qos::keep_last(10).transient_local());
    assert_eq!(told(&mirror.look(&here, &[latched(7)])), ["in /x latched [7]"]);
    let three = [latched(7), latched(8), latched(9)];
    assert_eq!(told(&mirror.look(&here, &three)), ["change /x latched [7, 8, 9]"]);
    let four = [latched(7), latched(8), latched(9), latched(10)];
    assert_eq!(told(&mirror.look(&here, &four)), ["in /x latched [7, 8, 9, 10]"], "it must keep more");
    assert_eq!(told(&mirror.look(&here, &three)), ["change /x latched [7, 8, 9]"]);
}

#[test]
fn what_failed_is_not_tried_again_after_what_came_later() {
    let mut mirror = auto();
    let here = [publisher("/x", 1), subscription("/x", 2)];
    let there = [publisher("/x", 7), subscription("/x", 8)];
    let begin = mirror.look(&here, &there);
    let [open, out, start] = begin.as_slice() else { panic!("{begin:?}") };
    let change = &mirror.look(&here, &[there[0].clone(), there[1].clone(), publisher("/x", 9)])[0];
    let ends = mirror.look(&[], &[]);
    let [stop_out, close, stop_in] = ends.as_slice() else { panic!("{ends:?}") };
    let all = [open, out, start, change, stop_out, close, stop_in];
    let replaced = |action: &Action| {
        told(&all.map(Action::clone).into_iter().filter(|failed| action.replaces(failed)).collect::<Vec<_>>())
    };
    assert_eq!(replaced(open), ["open /x 1"]);
    assert_eq!(replaced(close), ["open /x 1"]);
    assert_eq!(replaced(out), ["take /x 10"]);
    assert_eq!(replaced(stop_out), ["take /x 10"]);
    // A change of a class that could not be started belongs to that start.
    assert_eq!(replaced(change), ["change /x default [7, 9]"]);
    assert_eq!(replaced(start), ["in /x default [7]", "change /x default [7, 9]"]);
    assert_eq!(replaced(stop_in), ["in /x default [7]", "change /x default [7, 9]"]);
}

#[test]
fn what_rules_say() {
    let (here, there) =
        ([publisher("/x", 1), subscription("/x", 2)], [publisher("/y", 7), subscription("/y", 8)]);
    let mut renamed = ruled(Rule { far_topic: Some("/y".parse().unwrap()), ..rule("/x") });
    assert_eq!(told(&renamed.look(&here, &there)), ["open /y 1", "take /x 10", "in /y default [7]"]);
    let one_way =
        |direction| Rule { direction: Some(direction), far_topic: Some("/y".parse().unwrap()), ..rule("/x") };
    assert_eq!(told(&ruled(one_way(Direction::In)).look(&here, &there)), ["in /y default [7]"]);
    assert_eq!(told(&ruled(one_way(Direction::Out)).look(&here, &there)), ["open /y 1", "take /x 10"]);
    assert!(ruled(rule("/z")).look(&here, &there).is_empty());

    let qos =
        QosOverride { reliability: Some(Reliability::BestEffort), depth: Some(3), ..QosOverride::default() };
    let mut weakened = ruled(Rule { qos, ..rule("/x") });
    let actions = weakened.look(&here, &[publisher("/x", 7)]);
    assert_eq!(told(&actions), ["open /x 1", "in /x best effort [7]"]);
    let (Action::OpenWriter(_, _, out, _), Action::StartIn(_, inward)) = (&actions[0], &actions[1]) else {
        panic!()
    };
    assert_eq!((*out, inward.qos), (Qos::keep_last(3).best_effort(), Qos::keep_last(3).best_effort()));
    let qos = QosOverride { durability: Some(Durability::TransientLocal), ..QosOverride::default() };
    let mut demanding = ruled(Rule { qos, ..rule("/x") });
    demanding.look(&here, &[publisher("/x", 7)]);
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
    let actions = told(&mirror.look(&here, &there));
    assert_eq!(actions, ["in /fine default [8]", "in /x default []"]);
    let said = &mirror.problems()["/x"];
    assert!(said.contains("std_msgs/msg/Int32") && said.contains(STRING), "{said}");
    // A topic with two types: the common one.
    assert_eq!(
        told(&mirror.look(&here, &[int, publisher("/x", 9), publisher("/fine", 8)])),
        ["change /x default [9]"]
    );
    assert!(mirror.problems().is_empty());
    // The same name, defined differently.
    let mut mirror = auto();
    mirror.look(&[hashed(subscription("/x", 1), "1")], &[hashed(publisher("/x", 7), "2")]);
    assert!(mirror.problems()["/x"].contains("defined differently"), "{:?}", mirror.problems());
    // Of two types here, the one in ROS, with the definition there.
    let mut mirror = auto();
    let int = |end| typed(end, "std_msgs/msg/Int32");
    let here = [hashed(publisher("/x", 1), "1"), hashed(publisher("/x", 2), "2"), int(publisher("/x", 3))];
    let there = [hashed(subscription("/x", 7), "2")];
    let actions = mirror.look(&here, &there);
    assert_eq!(told(&actions), ["open /x 2", "take /x 10"]);
    let Action::OpenWriter(_, _, _, Some(hash)) = &actions[0] else { panic!("{actions:?}") };
    assert!(hash.ends_with("2222") && mirror.problems().is_empty());
    let both = [there[0].clone(), int(subscription("/x", 8))];
    assert!(mirror.look(&here, &both).is_empty(), "it stays the same");
    assert!(mirror.problems()["/x"].contains("one type of a topic"), "{:?}", mirror.problems());
    let actions = mirror.look(&here, &both[1..]);
    assert_eq!(told(&actions), ["stop /x", "close /x 2", "open /x 3", "take /x 10"]);
    assert!(mirror.problems().is_empty());
    let mut expecting = ruled(Rule { type_name: Some("a/msg/B".into()), ..rule("/x") });
    assert!(expecting.look(&[subscription("/x", 1)], &[publisher("/x", 7)]).is_empty());
    assert!(expecting.problems()["/x"].contains("the configuration says a/msg/B"));
}

/// A network, where endpoints state their type's hash.
struct Net {
    mirror: Mirror,
    here: Vec<TopicEndpoint>,
    there: Vec<(TopicEndpoint, bool)>,
}

fn stated(end: TopicEndpoint) -> TopicEndpoint {
    let topic_type = end.topic_type.clone().with_hash("RIHS01_1");
    TopicEndpoint { topic_type, ..end }
}

impl Net {
    fn new() -> Self {
        let rules = Rules { auto: true, ..Rules::default() };
        Net { mirror: Mirror::new(Side::Network, rules), here: Vec::new(), there: Vec::new() }
    }

    fn here(&mut self, ends: &[TopicEndpoint]) -> Vec<String> {
        self.here = ends.iter().cloned().map(stated).collect();
        self.look()
    }

    /// Sets the endpoints there; all come in here except those passed over.
    fn there(&mut self, ends: &[TopicEndpoint], passed_over: &[u8]) -> Vec<String> {
        let comes_in = |end: &TopicEndpoint| !passed_over.contains(&end.gid.0[0]);
        self.there = ends.iter().map(|end| (stated(end.clone()), comes_in(end))).collect();
        self.look()
    }

    fn look(&mut self) -> Vec<String> {
        let there: Vec<Far> = self.there.iter().map(|(end, comes_in)| (end, *comes_in)).collect();
        let kept = |qos: &Qos| if qos.durability == Durability::TransientLocal { ", kept" } else { "" };
        let actions = self.mirror.update(&self.here, &there);
        let one = |action: &Action| match action {
            Action::StartIn(_, now) => format!(" {}{}", now.qos.depth, kept(&now.qos)),
            Action::StartOut(_, out) if out.is_kept => ", kept".to_owned(),
            _ => String::new(),
        };
        told(&actions).into_iter().zip(&actions).map(|(text, action)| text + &one(action)).collect()
    }
}

const NOTHING: [&str; 0] = [];

fn kept(end: TopicEndpoint, depth: usize) -> TopicEndpoint {
    TopicEndpoint { qos: Qos::keep_last(depth).transient_local(), ..end }
}

#[test]
fn to_a_network_while_both_ends_exist() {
    let mut net = Net::new();
    assert_eq!(net.here(&[publisher("/x", 1)]), ["open /x 1"]);
    assert_eq!(net.there(&[subscription("/x", 7)], &[]), ["take /x 10"]);
    let both = [subscription("/x", 7), subscription("/x", 8), publisher("/x", 9)];
    assert_eq!(net.there(&both, &[]), NOTHING, "one route serves both, and there is no subscription here");
    let deeper = end(EndpointKind::Publisher, "/x", 2, Qos::keep_last(50));
    assert_eq!(net.here(&[publisher("/x", 1), deeper.clone()]), ["open /x 2", "take /x 50"]);
    assert_eq!(net.here(&[publisher("/x", 1)]), ["close /x 2"]);
    assert_eq!(net.here(&[publisher("/x", 1), deeper]), ["open /x 2"], "the queue stays as long");
    assert_eq!(net.there(&[], &[]), ["stop /x"]);
    // Samples of remote publishers arrive in bursts.
    let mut net = Net::new();
    net.there(&[subscription("/x", 7)], &[]);
    let origin = tautline_transport::Origin { tag: 7, path: vec![3], ..Default::default() };
    let far = TopicEndpoint { origin, ..publisher("/x", 1) };
    assert_eq!(net.here(std::slice::from_ref(&far)), ["open /x 1", &format!("take /x {RELAYED_DEPTH}")]);
}

#[test]
fn a_network_is_given_what_is_kept_before_anybody_listens() {
    let mut net = Net::new();
    let map = kept(publisher("/map", 1), 10);
    assert_eq!(net.here(std::slice::from_ref(&map)), ["open /map 1", "take /map 10, kept"]);
    assert_eq!(net.there(&[subscription("/map", 7)], &[]), NOTHING);
    // Another, volatile publisher changes nothing, even if only that remains.
    assert_eq!(net.here(&[map.clone(), publisher("/map", 2)]), ["open /map 2"]);
    assert_eq!(net.here(&[publisher("/map", 2)]), ["close /map 1"]);
    assert_eq!(net.there(&[], &[]), ["stop /map"]);
    // A remote publisher that was passed over until now: its kept samples are taken again.
    net.here(std::slice::from_ref(&map));
    let origin = tautline_transport::Origin { tag: 7, path: vec![3], ..Default::default() };
    let far = TopicEndpoint { origin, ..kept(publisher("/map", 3), 1) };
    let depth = RELAYED_DEPTH;
    assert_eq!(net.here(&[map.clone(), far.clone()]), ["open /map 3", &format!("take /map {depth}, kept")]);
    assert_eq!(net.here(std::slice::from_ref(&map)), ["close /map 3"]);
    let again = format!("take /map {depth}, kept");
    assert_eq!(net.here(&[map.clone(), far]), ["open /map 3", &again]);
    // The same after its writer was ended, with the samples that it kept.
    let key = net.mirror.out.keys().next().unwrap().clone();
    net.mirror.forget_writer(&key, map.gid);
    assert_eq!(net.look(), ["open /map 1", &again]);
    assert_eq!(net.look(), NOTHING);
}

#[test]
fn from_a_network_while_both_ends_exist_and_through_one_port() {
    let mut net = Net::new();
    assert_eq!(net.there(&[publisher("/x", 7)], &[]), NOTHING);
    let two = [subscription("/x", 1), subscription("/x", 2)];
    assert_eq!(net.here(&two), ["in /x all [7] 1"], "once for all subscriptions of the host");
    let best_effort = end(EndpointKind::Publisher, "/x", 8, Qos::default().best_effort());
    assert_eq!(net.there(&[publisher("/x", 7), best_effort.clone()], &[]), ["change /x all [7, 8]"]);
    assert_eq!(net.there(&[best_effort], &[]), ["change /x all [8]"], "without an interruption");
    assert_eq!(net.here(&[]), ["end /x all"]);
    // Publishers whose messages come another way are passed over; a class with only these is not taken.
    net.here(&two);
    let three = [publisher("/x", 7), publisher("/x", 8)];
    assert_eq!(net.there(&three, &[7]), ["change /x all [8]"]);
    assert_eq!(net.there(&three, &[]), ["change /x all [7, 8]"]);
    assert_eq!(net.there(&three, &[7, 8]), ["end /x all"]);
}

#[test]
fn what_a_network_keeps_is_asked_for_if_both_ends_are_transient_local() {
    let mut net = Net::new();
    net.here(&[kept(subscription("/map", 1), 10)]);
    let (few, more) = (kept(publisher("/map", 7), 3), kept(publisher("/map", 8), 2));
    assert_eq!(net.there(std::slice::from_ref(&few), &[]), ["in /map all [7] 10, kept"]);
    assert_eq!(net.there(&[few.clone(), more.clone()], &[]), ["change /map all [7, 8]"]);
    assert_eq!(net.there(std::slice::from_ref(&few), &[]), ["change /map all [7]"]);
    // Kept samples of one that came another way have not been received here.
    assert_eq!(net.there(&[few.clone(), more.clone()], &[8]), ["change /map all [7]"]);
    assert_eq!(net.there(&[few, more], &[]), ["again /map all [7, 8]"]);
    assert_eq!(net.here(&[subscription("/map", 1)]), NOTHING, "what runs does not shrink");
    assert_eq!(net.here(&[kept(subscription("/map", 1), 20)]), ["in /map all [7, 8] 20, kept"]);
    // No subscription gets more than its depth, whatever publishers claim to keep; volatile publishers are not asked.
    let mut net = Net::new();
    net.here(&[kept(subscription("/few", 1), 10), kept(subscription("/none", 2), 10)]);
    let there = [kept(publisher("/few", 7), usize::MAX), publisher("/none", 8)];
    assert_eq!(net.there(&there, &[]), ["in /few all [7] 10, kept", "in /none all [8] 1"]);
}

#[test]
fn on_a_network_each_definition_of_a_topic_is_one_of_its_own() {
    let mut net = Net::new();
    let changed = |end| {
        let topic_type = TopicType::new(STRING).with_hash("RIHS01_2");
        TopicEndpoint { topic_type, ..end }
    };
    net.here(&[publisher("/x", 1), subscription("/x", 2)]);
    net.there = vec![(changed(subscription("/x", 7)), false)];
    assert_eq!(net.look(), NOTHING);
    assert!(net.mirror.problems()["/x"].contains("RIHS01_2"), "{:?}", net.mirror.problems());
    let bool = TopicEndpoint { topic_type: TopicType::new("std_msgs/msg/Bool"), ..publisher("/x", 8) };
    net.there = vec![(bool, true)];
    assert_eq!(net.look(), NOTHING);
    assert!(net.mirror.problems()["/x"].contains("std_msgs/msg/Bool"), "{:?}", net.mirror.problems());
    // Unless there is also an endpoint of that type here.
    net.here.push(changed(publisher("/x", 3)));
    net.there = vec![(changed(subscription("/x", 7)), false)];
    assert_eq!(net.look(), ["open /x 3", "take /x 10"]);
    assert!(net.mirror.problems().is_empty());
}
