// SPDX-License-Identifier: MIT OR Apache-2.0
//! A callback group over two topics and a timer is one queue, in order of release.

mod common;

use std::time::Duration;

use common::{Log, Number, context, spin};
use tautline::{CallbackGroup, CallbackOptions, Node, Publisher, Qos, Sample, Tick};
use tautline_rt::clock;

const HOUR: Duration = Duration::from_secs(3600);

fn publish_released_at(publisher: &Publisher<Number>, released_ns: u64) {
    let mut loan = publisher.loan().unwrap();
    loan.value = 0;
    loan.publish_released_at(released_ns).unwrap();
}

#[test]
fn jobs_run_in_order_of_release_across_topics_and_a_timer() {
    static LOG: Log<(&str, u64)> = Log::new();
    let context = context(219);
    let mut node = Node::create(context.clone(), "grouped", "").unwrap();
    let [a, b] = ["/a", "/b"].map(|topic| {
        let subscription = node.subscribe::<Number>(topic, Qos::default()).unwrap();
        (subscription, node.create_publisher::<Number>(topic, Qos::default()).unwrap())
    });
    // Everything is released before the group starts, and not in the order in which it was published.
    let start_ns = clock::monotonic_ns();
    let timer = node.create_wall_timer_at(start_ns + 25, HOUR).unwrap();
    for (publisher, offset_ns) in [(&b.1, 20), (&b.1, 30), (&b.1, 40), (&a.1, 10), (&a.1, 40), (&a.1, 50)] {
        publish_released_at(publisher, start_ns + offset_ns);
    }
    // The timer's release needs a sampler.
    context.spin_once(HOUR);

    let mut group = CallbackGroup::new();
    let member =
        |name| move |sample: Sample<Number>| async move { LOG.add((name, sample.info().released_ns)) };
    let release = |sample: &Sample<Number>| sample.info().released_ns;
    let stats = [
        group.add("/a", a.0, release, member("/a")),
        group.add("/b", b.0, release, member("/b")),
        group.add(
            "timer",
            timer,
            |tick: &Tick| tick.since_ns,
            |tick| async move { LOG.add(("timer", tick.release_ns)) },
        ),
    ];
    let callback = node.spawn_group(CallbackOptions::other().name("group"), group).unwrap();
    let expected = [("/a", 10), ("/b", 20), ("timer", 25), ("/b", 30), ("/a", 40), ("/b", 40), ("/a", 50)];
    let expected = expected.map(|(name, offset_ns)| (name, start_ns + offset_ns));
    assert_eq!(LOG.wait_for(7), expected);

    // From here on the sampler wakes it.
    let _spinning = spin(&context);
    for (publisher, offset_ns) in [(&b.1, 60), (&a.1, 70)] {
        let logged = LOG.events().len();
        publish_released_at(publisher, start_ns + offset_ns);
        LOG.wait_for(logged + 1);
    }
    assert_eq!(LOG.events()[7..], [("/b", start_ns + 60), ("/a", start_ns + 70)]);
    callback.stop();
    let total = callback.stats().clone();
    callback.join().unwrap();
    assert_eq!(stats.map(|member| (member.releases(), member.completions())), [(4, 4), (4, 4), (1, 1)]);
    assert_eq!((total.releases(), total.completions(), total.response().snapshot().n()), (9, 9, 9));
}
