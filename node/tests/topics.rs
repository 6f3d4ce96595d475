// SPDX-License-Identifier: MIT OR Apache-2.0
//! Names, quality of service and limits, through a node.

mod common;

use common::{Number, context, spin};
use futures::StreamExt;
use tautline::{Limits, LoanError, Node, Qos, Subscription, TakeError};

fn node(domain: u32, name: &str, namespace: &str) -> Node {
    Node::create(context(domain), name, namespace).unwrap()
}

fn take_all(subscription: &Subscription<Number>) -> Vec<u64> {
    std::iter::from_fn(|| subscription.try_take().unwrap().map(|sample| sample.value)).collect()
}

#[test]
fn names_are_those_of_ros_2_from_end_to_end() {
    let context = context(213);
    let mut cam = Node::create(context.clone(), "cam", "/robot").unwrap();
    let mut other = Node::create(context, "viewer", "robot").unwrap();
    // (published by cam, its full name, how the viewer writes it)
    for (topic, full, seen) in [
        ("~/image", "/robot/cam/image", "cam/image"),
        ("image", "/robot/image", "image"),
        ("/image", "/image", "/image"),
        ("{node}/raw", "/robot/cam/raw", "/robot/cam/raw"),
    ] {
        let subscription = other.subscribe::<Number>(full, Qos::default()).unwrap();
        let relative = other.subscribe::<Number>(seen, Qos::default()).unwrap();
        let publisher = cam.create_publisher::<Number>(topic, Qos::default()).unwrap();
        publisher.publish(&Number { value: 3 }).unwrap();
        assert_eq!((publisher.topic(), subscription.topic(), relative.topic()), (full, full, full));
        assert_eq!((take_all(&subscription), take_all(&relative)), (vec![3], vec![3]), "{topic}");
        assert_eq!(subscription.publisher_count(), 1);
    }
}

#[test]
fn bad_names_are_refused_with_the_reason() {
    let context = context(213);
    for (name, namespace, reason) in [
        ("", "", "it is empty"),
        ("a/b", "", "put what comes before it into the namespace"),
        ("9a", "", "begins with a digit"),
        ("a", "/robot/", "ends with '/'"),
        ("a", "ro bot", "' ' is not allowed"),
    ] {
        let message = Node::create(context.clone(), name, namespace).unwrap_err().to_string();
        assert!(message.contains(reason), "{message}");
    }
    let mut node = Node::create(context, "cam", "").unwrap();
    for (topic, reason) in
        [("a//b", "nothing between two '/'"), ("~image", "followed by '/'"), ("a-b", "not allowed")]
    {
        let errors = [
            node.create_publisher::<Number>(topic, Qos::default()).err().unwrap(),
            node.subscribe::<Number>(topic, Qos::default()).err().unwrap(),
            node.subscribe::<Number>(topic, Qos::default()).err().unwrap(),
            node.set_topic_limits(topic, Limits::default()).err().unwrap(),
        ];
        for error in errors {
            let message = error.to_string();
            assert!(message.starts_with(&format!("'{topic}' is not a valid topic name")), "{message}");
            assert!(message.contains(reason), "{message}");
        }
    }
}

#[test]
fn a_transient_local_late_joiner_gets_the_last_and_a_volatile_one_does_not() {
    let context = context(215);
    let mut node = Node::create(context.clone(), "latch", "").unwrap();
    let latched = Qos::keep_last(2).transient_local();
    let publisher = node.create_publisher::<Number>("/map", latched).unwrap();
    (1..=5).for_each(|value| publisher.publish(&Number { value }).unwrap());
    let volatile = node.subscribe::<Number>("/map", Qos::default()).unwrap();
    let late = node.subscribe::<Number>("/map", latched).unwrap().owned();
    let _spinning = spin(&context);
    let history = late.take(2).map(|number| number.value).collect::<Vec<_>>();
    assert_eq!(futures::executor::block_on(history), [4, 5]);
    assert!(take_all(&volatile).is_empty());
}

#[test]
fn limits_are_each_ends_own_and_exceeding_one_names_it() {
    let mut node = node(216, "limited", "/ns");
    let limits = Limits { held: 2, loans: 2, ..Limits::default() };
    let qos = Qos::keep_last(4);
    // By any of the topic's names.
    node.set_topic_limits("t", limits).unwrap();
    let publisher = node.create_publisher::<Number>("/ns/t", qos).unwrap();
    assert_eq!(publisher.limits(), Limits { message_bytes: 8, may_grow: false, ..limits }, "of a fixed size");
    let deep = node.subscribe::<Number>("t", qos.depth(5)).unwrap();
    let subscription = node.subscribe::<Number>("t", qos).unwrap();
    let _another = node.create_publisher::<Number>("t", qos.depth(7)).unwrap();

    let loans = [publisher.loan().unwrap(), publisher.loan().unwrap()];
    assert_eq!(publisher.loan().err(), Some(LoanError::Exhausted));
    for (loan, value) in loans.into_iter().zip([1, 2]) {
        let mut loan = loan;
        loan.value = value;
        loan.publish().unwrap();
    }
    publisher.publish(&Number { value: 3 }).unwrap();
    let held = [subscription.try_take().unwrap().unwrap(), subscription.try_take().unwrap().unwrap()];
    assert_eq!(subscription.try_take().err(), Some(TakeError::TooManyHeld));
    assert_eq!(held.each_ref().map(|sample| sample.value), [1, 2]);
    drop(held);
    assert_eq!(take_all(&subscription), [3]);
    assert_eq!(take_all(&deep), [1, 2, 3]);

    node.set_topic_limits("u", Limits { held: 0, ..limits }).unwrap();
    let message = node.create_publisher::<Number>("u", qos).err().unwrap().to_string();
    assert!(message.contains("'/ns/u'") && message.contains("held = 0 is outside 1 to "), "{message}");
}
