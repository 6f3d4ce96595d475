// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which thread runs at which priority, on which core.

mod common;

use std::sync::mpsc;

use common::{Log, Number, context, cores, realtime};
use futures::StreamExt;
use tautline::{CallbackOptions, Context, CoreSet, Error, Node, Policy, Qos, Sample};
use tautline_rt::{current_affinity, current_policy, current_tid, threads};

/// What the kernel says of this thread.
fn settings() -> (Policy, CoreSet) {
    (current_policy().unwrap(), current_affinity().unwrap())
}

fn settings_of(tid: u32) -> (Policy, CoreSet) {
    let thread = threads().unwrap().into_iter().find(|thread| thread.tid == tid).unwrap();
    (thread.policy, thread.cores)
}

/// Two callbacks, named after their topics, that log the thread they run on.
fn callbacks(
    node: &mut Node,
    core: usize,
    log: &'static Log<(u32, String)>,
) -> [tautline::Publisher<Number>; 2] {
    [("/high", 30), ("/low", 29)].map(|(topic, priority)| {
        let numbers = node.subscribe::<Number>(topic, Qos::default()).unwrap();
        let note = |_: Sample<Number>| async {
            log.add((current_tid(), std::thread::current().name().unwrap_or_default().to_owned()));
        };
        node.spawn_callback(CallbackOptions::fifo(priority).core(core).name(topic), numbers.for_each(note))
            .unwrap();
        node.create_publisher(topic, Qos::default()).unwrap()
    })
}

#[test]
fn every_thread_has_its_priority_while_it_spins_and_the_sampler_its_own_afterwards() {
    static LOG: Log<(u32, String)> = Log::new();
    if !realtime() {
        return;
    }
    let (first, last) = (cores()[0], *cores().last().unwrap());
    let context = Context::builder().domain(207).sampler_priority(40).sampler_core(first).build().unwrap();
    let mut node = Node::create(context.clone(), "spinner", "").unwrap();
    let publishers = callbacks(&mut node, last, &LOG);

    let (report, reported) = mpsc::channel();
    let spinning = context.clone();
    let sampler = std::thread::spawn(move || {
        let before = settings();
        report.send(current_tid()).unwrap();
        spinning.spin().unwrap();
        (before, settings())
    });
    let sampler_tid = reported.recv().unwrap();
    for (index, publisher) in publishers.iter().enumerate() {
        publisher.publish(&Number { value: 0 }).unwrap();
        LOG.wait_for(index + 1);
    }
    // A callback was woken, so the sampler is one.
    assert_eq!(settings_of(sampler_tid), (Policy::Fifo(40), CoreSet::one(first)));
    let callbacks = LOG.events().into_iter().map(|(tid, name)| (name, settings_of(tid))).collect::<Vec<_>>();
    let expected = [("cb:/high", 30), ("cb:/low", 29)]
        .map(|(name, priority)| (name.to_owned(), (Policy::Fifo(priority), CoreSet::one(last))));
    assert_eq!(callbacks, expected);

    let own = settings();
    assert!(matches!(context.spin(), Err(Error::AlreadySpinning)));
    assert_eq!(settings(), own);

    context.shutdown();
    let (before, after) = sampler.join().unwrap();
    assert_eq!(after, before);
    assert!(matches!(before.0, Policy::Other { .. }));
}

#[test]
fn without_real_time_nothing_is_set_but_cores() {
    static LOG: Log<(u32, String)> = Log::new();
    let context = context(208);
    let mut node = Node::create(context.clone(), "spinner", "").unwrap();
    let publishers = callbacks(&mut node, cores()[0], &LOG);
    let own = settings();
    let spinning = context.clone();
    let sampler = std::thread::spawn(move || (current_tid(), spinning.spin().unwrap(), settings()));
    publishers[0].publish(&Number { value: 0 }).unwrap();
    let callback = LOG.wait_for(1)[0].clone();
    assert_eq!(settings_of(callback.0), (own.0, CoreSet::one(cores()[0])));
    assert!(matches!(node.spin(), Err(Error::AlreadySpinning)));
    // Where another thread spins, this only waits.
    node.spin_once(std::time::Duration::from_millis(1));
    context.shutdown();
    let (_, (), after) = sampler.join().unwrap();
    assert_eq!(after, own);
}

#[test]
fn a_core_that_does_not_exist_is_an_error_and_leaves_the_thread_as_it_was() {
    if !realtime() {
        return;
    }
    let context = Context::builder().domain(208).sampler_core(1023).build().unwrap();
    let own = settings();
    let message = context.spin().unwrap_err().to_string();
    assert!(message.contains("core 1023 does not exist"), "{message}");
    assert_eq!(settings(), own);
    // The sampler was put back: the next call fails for the same reason.
    assert!(matches!(context.spin(), Err(Error::Realtime(_))));
}
