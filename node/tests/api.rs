// SPDX-License-Identifier: MIT OR Apache-2.0
//! The program of the design, as it is written there; several contexts; what may move between threads.

mod common;

use std::collections::HashSet;

use common::{Log, Number, context, cores, realtime, run_again, spin};
use futures::StreamExt;
use static_assertions::{assert_impl_all, assert_not_impl_any};
use tautline::{
    CallbackOptions, Context, LoanError, Message, Node, PublishError, Publisher, Qos, Sample, Subscription,
    Timer,
};

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "test_msgs/msg/Odometry")]
struct Odometry {
    x: f64,
    heading: f64,
}

// Each is used by one thread at a time, whichever that is.
assert_impl_all!(Publisher<Odometry>: Send);
assert_impl_all!(Subscription<Odometry>: Send, Unpin);
assert_impl_all!(Timer: Send, Unpin);
assert_not_impl_any!(Publisher<Odometry>: Sync);
assert_not_impl_any!(Subscription<Odometry>: Sync);
// Read and dropped anywhere.
assert_impl_all!(Sample<Odometry>: Send, Sync);
assert_impl_all!(Context: Send, Sync, Clone);
assert_impl_all!(Node: Send);

static ODOMETRY: Log<(f64, f64)> = Log::new();

fn program(
    core: usize,
    publish_and_end: impl FnOnce(Publisher<Odometry>, Context) + Send + 'static,
) -> tautline::Result<()> {
    let ctx = Context::create()?;
    let mut node = Node::create(ctx, "example", "")?;
    let odometry = node.subscribe::<Odometry>("/odom", Qos::default())?;
    node.spawn_callback(
        CallbackOptions::fifo(20).core(core),
        odometry.for_each(|msg| async move {
            ODOMETRY.add((msg.x, msg.heading));
        }),
    )?;
    let publisher = node.create_publisher::<Odometry>("/odom", Qos::default())?;
    let ctx = node.context().clone();
    let thread = std::thread::spawn(|| publish_and_end(publisher, ctx));
    node.spin()?;
    thread.join().unwrap();
    Ok(())
}

#[test]
fn the_program_of_the_design_runs_until_shutdown() {
    let policy = if realtime() { "required" } else { "off" };
    let variables = [("TAUT_DOMAIN", "200"), ("TAUT_REALTIME", policy)];
    if let Some(output) = run_again("the_program_of_the_design_runs_until_shutdown", &variables) {
        return assert!(output.status.success(), "{output:?}");
    }
    program(cores()[0], |publisher, ctx| {
        for x in [1.0, 2.0, 3.0] {
            publisher.publish(&Odometry { x, heading: -x }).unwrap();
        }
        ODOMETRY.wait_for(3);
        ctx.shutdown();
        assert!(!ctx.is_valid());
    })
    .unwrap();
    assert_eq!(ODOMETRY.events(), [(1.0, -1.0), (2.0, -2.0), (3.0, -3.0)]);
}

#[test]
fn two_contexts_of_a_process_share_a_domain_and_no_more() {
    static HEARD: Log<(&str, u64)> = Log::new();
    let (here, there, elsewhere) = (context(201), context(201), context(202));
    let nodes = [("there", &there), ("elsewhere", &elsewhere)].map(|(name, context)| {
        let mut node = Node::create(context.clone(), name, "").unwrap();
        let numbers = node.subscribe::<Number>("/two", Qos::default()).unwrap();
        let log = move |sample: Sample<Number>| async move { HEARD.add((name, sample.value)) };
        node.spawn_callback(CallbackOptions::other(), numbers.for_each(log)).unwrap();
        node
    });
    let publish = |context: &Context, value| {
        let mut node = Node::create(context.clone(), "talker", "").unwrap();
        let publisher = node.create_publisher::<Number>("/two", Qos::default()).unwrap();
        assert_eq!(publisher.subscription_count(), 1);
        publisher.publish(&Number { value }).unwrap();
        publisher
    };
    let _spinning = [spin(&there), spin(&elsewhere)];
    // The publisher's own context need not spin.
    let first = publish(&here, 1);
    assert_eq!(HEARD.wait_for(1), [("there", 1)]);
    let _second = publish(&elsewhere, 2);
    assert_eq!(HEARD.wait_for(2), [("there", 1), ("elsewhere", 2)]);
    // One may go while the other stays.
    drop((first, here));
    let _third = publish(&there, 3);
    assert_eq!(HEARD.wait_for(3)[2], ("there", 3));
    drop(nodes);
}

#[test]
fn publishers_and_samples_may_end_on_other_threads() {
    let mut node = Node::create(context(203), "mover", "").unwrap();
    let publisher = node.create_publisher::<Number>("/moved", Qos::default()).unwrap();
    let subscription = node.subscribe::<Number>("/moved", Qos::default()).unwrap();
    let publisher = std::thread::spawn(move || {
        publisher.publish(&Number { value: 7 }).unwrap();
        publisher
    });
    let publisher = publisher.join().unwrap();
    // What came is there, and nothing more: the context is kept by what it made.
    drop(node);
    assert_eq!(publisher.publish(&Number { value: 8 }), Err(PublishError::Loan(LoanError::Ended)));
    let sample = subscription.try_take().unwrap().unwrap();
    assert_eq!(sample.info().publisher_gid, publisher.gid());
    assert!(subscription.try_take().unwrap().is_none());
    drop((publisher, subscription));
    let read = std::thread::spawn(move || (sample.value, sample.info().sequence_number));
    assert_eq!(read.join().unwrap(), (7, 1));
}

/// Whoever waits for something of a node is told of its end: streams and timers.
#[test]
fn what_is_made_through_a_node_ends_with_it() {
    let context = context(204);
    let mut node = Node::create(context.clone(), "brief", "").unwrap();
    let qos = Qos::default();
    let publisher = node.create_publisher::<Number>("/brief", qos).unwrap();
    let numbers = node.subscribe::<Number>("/brief", qos).unwrap().owned();
    let mut silent = node.subscribe::<Number>("/silent", qos).unwrap();
    let mut events = node.subscription_events(&silent).unwrap();
    let mut timer = node.create_wall_timer(std::time::Duration::from_secs(3600)).unwrap();
    (1..=3).for_each(|value| publisher.publish(&Number { value }).unwrap());
    // On another thread, where nothing but the end wakes it.
    let waits = std::thread::spawn(move || {
        futures::executor::block_on(async {
            let all = numbers.map(|number| number.value).collect::<Vec<_>>();
            let ends = futures::join!(all, silent.next(), timer.tick());
            while events.next().await.is_some() {}
            (ends.0, ends.1.is_none(), ends.2.unwrap_err().to_string())
        })
    });
    drop(node);
    let (all, is_over, error) = waits.join().unwrap();
    assert_eq!((all, is_over), (vec![1, 2, 3], true));
    assert!(error.contains("the node was dropped"), "{error}");
}

#[test]
fn names_of_contexts_and_nodes_are_what_was_asked_for() {
    let context = context(204);
    assert_eq!(
        (context.domain(), context.realtime(), context.is_valid()),
        (204, tautline::Realtime::Off, true)
    );
    let nodes = [("a", ""), ("a", "/robot"), ("b", "robot/left")]
        .map(|(name, namespace)| Node::create(context.clone(), name, namespace).unwrap());
    let names = nodes.iter().map(|node| node.fully_qualified_name()).collect::<HashSet<_>>();
    assert_eq!(names, HashSet::from(["/a", "/robot/a", "/robot/left/b"]));
}
