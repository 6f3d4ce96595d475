// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs in r2r's style: one thread that spins and runs a pool, owned messages, `tautline-r2r` for `r2r`.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::time::Duration;

use futures::executor::LocalPool;
use futures::future;
use futures::stream::StreamExt;
use futures::task::LocalSpawnExt;
use r2r::QosProfile;
use r2r::std_msgs::msg::UInt64;

/// `examples/subscriber.rs` of r2r 0.9.7: a task forwards every other message to a second topic of the same node.
#[test]
fn publishers_subscriptions_and_spin_once_in_one_thread() {
    let mut node = r2r::Node::create(super::context(205, ""), "testnode", "").unwrap();
    let mut sub = node.subscribe::<UInt64>("/topic", QosProfile::default()).unwrap();
    let p = node.create_publisher::<UInt64>("/topic2", QosProfile::default()).unwrap();

    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    spawner
        .spawn_local(async move {
            let mut x: i32 = 0;
            while let Some(msg) = sub.next().await {
                if x % 2 == 0 {
                    p.publish(&UInt64 { data: msg.data * 10 }).unwrap();
                }
                x += 1;
            }
        })
        .unwrap();

    let sub2 = node.subscribe::<UInt64>("/topic2", QosProfile::default()).unwrap();
    let heard = Rc::new(RefCell::new(Vec::new()));
    let log = heard.clone();
    spawner
        .spawn_local(async move {
            sub2.for_each(|msg| {
                log.borrow_mut().push(msg.data);
                future::ready(())
            })
            .await
        })
        .unwrap();

    let source = node.create_publisher::<UInt64>("/topic", QosProfile::default()).unwrap();
    for data in 1..=5 {
        source.publish(&UInt64 { data }).unwrap();
    }
    while heard.borrow().len() < 3 {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
    assert_eq!(*heard.borrow(), [10, 30, 50]);
}

/// Messages by r2r's paths, owned and of any length; beside them what r2r lacks: the same read where they lie.
#[test]
fn messages_of_any_length_by_their_ros_paths() {
    use r2r::sensor_msgs::msg::{JointState, JointStateSizes};
    let mut node = r2r::Node::create(super::context(199, ""), "testnode", "").unwrap();
    let qos = QosProfile::default();
    let words = node.subscribe::<r2r::std_msgs::msg::String>("/words", qos).unwrap();
    let joints = node.subscribe::<JointState>("/joints", qos).unwrap();
    let in_place = r2r::tautline::Node::subscribe::<JointState>(&mut node, "/joints", qos.into()).unwrap();
    let word_publisher = node.create_publisher::<r2r::std_msgs::msg::String>("/words", qos).unwrap();
    let joint_publisher = node.create_publisher::<JointState>("/joints", qos).unwrap();

    let said = ["", "taut", "a longer word"].map(|data| r2r::std_msgs::msg::String { data: data.into() });
    said.iter().for_each(|word| word_publisher.publish(word).unwrap());
    let sizes = JointStateSizes { name: &[4, 5], position: 2, ..JointStateSizes::default() };
    let write = || -> r2r::Result<()> {
        let loan = joint_publisher.loan_with(sizes)?.write(|joints| {
            joints.name.each(|index, name| name.set(["left", "right"][index]))?;
            joints.position.copy_from(&[0.5, -0.5])?;
            joints.default_rest();
            Ok(())
        })?;
        Ok(loan.publish()?)
    };
    write().unwrap();

    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    let heard = Rc::new(RefCell::new((Vec::new(), Vec::new(), Vec::new())));
    let log = heard.clone();
    let words = words.for_each(move |word| {
        log.borrow_mut().0.push(word);
        future::ready(())
    });
    let log = heard.clone();
    let joints = joints.for_each(move |state| {
        log.borrow_mut().1.push(state);
        future::ready(())
    });
    let log = heard.clone();
    let view = in_place.for_each(move |sample| {
        let state = sample.view();
        let named = state.name().iter().map(str::to_owned).zip(state.position().iter().copied());
        log.borrow_mut().2.extend(named);
        future::ready(())
    });
    spawner.spawn_local(words).unwrap();
    spawner.spawn_local(joints).unwrap();
    spawner.spawn_local(view).unwrap();
    while heard.borrow().0.len() < 3 || heard.borrow().1.is_empty() || heard.borrow().2.is_empty() {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
    let (words, joints, in_place) = &*heard.borrow();
    assert_eq!(words, &said);
    assert_eq!(joints[0].name, ["left", "right"]);
    assert_eq!((&joints[0].position, joints[0].effort.len()), (&vec![0.5, -0.5], 0));
    assert_eq!(in_place, &[("left".to_owned(), 0.5), ("right".to_owned(), -0.5)]);
}

/// `examples/rostopic_echo.rs` of r2r 0.9.7, its topic and type given: messages go on as they come, as JSON.
#[test]
fn an_echo_of_a_type_known_by_name() {
    let mut node = r2r::Node::create(super::context(190, ""), "echo", "").unwrap();
    let (topic, type_name) = ("/thetopic", "std_msgs/msg/String");
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();

    let echo = &format!("{}_echo", topic);
    let echo_pub = node.create_publisher_untyped(echo, type_name, QosProfile::default()).unwrap();
    let sub = node.subscribe_untyped(topic, type_name, QosProfile::default()).unwrap();
    let printed = Rc::new(RefCell::new(String::new()));
    let print = printed.clone();
    spawner
        .spawn_local(async move {
            sub.for_each(|msg| {
                match msg {
                    Ok(msg) => {
                        let s = serde_json::to_string_pretty(&msg).unwrap();
                        *print.borrow_mut() += &format!("{}\n---\n", &s);
                        echo_pub.publish(msg).unwrap();
                    }
                    Err(err) => panic!("Could not parse msg. {}", err),
                }
                future::ready(())
            })
            .await
        })
        .unwrap();

    let mut echoed = node.subscribe::<r2r::std_msgs::msg::String>(echo, QosProfile::default()).unwrap();
    let publisher =
        node.create_publisher::<r2r::std_msgs::msg::String>(topic, QosProfile::default()).unwrap();
    let message = r2r::std_msgs::msg::String { data: "taut".into() };
    publisher.publish(&message).unwrap();
    while printed.borrow().is_empty() {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
    assert_eq!(*printed.borrow(), "{\n  \"data\": \"taut\"\n}\n---\n");
    assert_eq!(pool.run_until(echoed.next()), Some(message));
}

/// `examples/tokio_raw_publisher.rs` and `tokio_raw_subscriber.rs` of r2r 0.9.7, on a pool. (`to_cdr` and `from_cdr` are
/// r2r's `to_serialized_bytes` and `from_serialized_bytes`.)
#[test]
fn raw_bytes_there_and_back() {
    use r2r::Message;
    let mut node = r2r::Node::create(super::context(190, ""), "testnode", "").unwrap();
    let publisher =
        node.create_publisher_untyped("/topic", "std_msgs/msg/String", QosProfile::default()).unwrap();
    let sub = node.subscribe_raw("/topic", "std_msgs/msg/String", QosProfile::default()).unwrap();
    for x in 5..8 {
        let msg = r2r::std_msgs::msg::String { data: format!("Hello{:>width$}", "World", width = x) };
        publisher.publish_raw(&msg.to_cdr().unwrap()).unwrap();
    }
    let heard = Rc::new(RefCell::new(Vec::new()));
    let log = heard.clone();
    let mut pool = LocalPool::new();
    let task = sub.for_each(move |msg| {
        log.borrow_mut().push(r2r::std_msgs::msg::String::from_cdr(&msg).unwrap().data);
        future::ready(())
    });
    pool.spawner().spawn_local(task).unwrap();
    while heard.borrow().len() < 3 {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
    assert_eq!(*heard.borrow(), ["HelloWorld", "Hello World", "Hello  World"]);
}

async fn timer_task(mut t: r2r::Timer) -> Result<Vec<Duration>, Box<dyn std::error::Error>> {
    let mut elapsed = Vec::new();
    loop {
        elapsed.push(t.tick().await?);
        if elapsed.len() == 10 {
            return Ok(elapsed);
        }
    }
}

/// `examples/wall_timer.rs` of r2r 0.9.7.
#[test]
fn a_wall_timer_ticks() {
    const PERIOD: Duration = Duration::from_millis(3);
    let mut node = r2r::Node::create(super::context(206, ""), "testnode", "").unwrap();
    let timer = node.create_wall_timer(PERIOD).unwrap();
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    let elapsed = Rc::new(Cell::new(None));
    let result = elapsed.clone();
    spawner.spawn_local(async move { result.set(Some(timer_task(timer).await.unwrap())) }).unwrap();
    let elapsed = loop {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
        if let Some(elapsed) = elapsed.take() {
            break elapsed;
        }
    };
    // Absolute releases: whatever this thread was late, whole periods.
    assert_eq!(elapsed.len(), 10);
    assert!(
        elapsed.iter().all(|time| *time >= PERIOD && time.as_nanos() % PERIOD.as_nanos() == 0),
        "{elapsed:?}"
    );
}

#[test]
fn a_timer_without_period_is_refused() {
    let mut node = r2r::Node::create(super::context(206, ""), "testnode", "").unwrap();
    for timer in [node.create_wall_timer(Duration::ZERO), node.create_timer(Duration::ZERO)] {
        let message = timer.err().unwrap().to_string();
        assert!(message.contains("period of zero"), "{message}");
    }
}

#[test]
fn spin_once_returns_without_events_and_after_shutdown() {
    let context = super::context(206, "");
    let mut node = r2r::Node::create(context.clone(), "testnode", "").unwrap();
    node.spin_once(Duration::ZERO);
    node.spin_once(Duration::from_millis(1));
    context.shutdown();
    node.spin_once(Duration::from_secs(3600));
    node.spin().unwrap();
}
