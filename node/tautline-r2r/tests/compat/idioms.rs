// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs in r2r's style: one thread that spins and runs a pool, owned messages, `tautline-r2r` for `r2r`.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::executor::LocalPool;
use futures::future;
use futures::stream::StreamExt;
use futures::task::LocalSpawnExt;
use r2r::{Clock, ClockType, QosProfile};

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

#[test]
fn a_clock_of_ones_own_shows_the_systems_time_after_the_simulation() {
    let mut node = r2r::Node::create(super::context(165, ""), "testnode", "").unwrap();
    let time_source = node.get_time_source();
    time_source.enable_sim_time(&mut node).unwrap();
    time_source.disable_sim_time();
    let own = Arc::new(Mutex::new(Clock::create(ClockType::RosTime).unwrap()));
    time_source.attach_ros_clock(Arc::downgrade(&own)).unwrap();
    let mut own = own.lock().unwrap();
    assert!(own.get_now().unwrap().as_secs() > 1_600_000_000);
    assert_eq!(format!("{:?}", own.get_clock_type()), "RosTime");
}
