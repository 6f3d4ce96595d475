// SPDX-License-Identifier: MIT OR Apache-2.0
//! A context that came and went leaves nothing. Alone in its file: it counts what the process has.

mod common;

use common::{Log, Number, context, spin};
use futures::StreamExt;
use tautline::{CallbackOptions, Node, Qos};

const DOMAIN: u32 = 226;
/// `TAUT_LEAK_CYCLES` says otherwise.
const CYCLES: usize = 100;

fn cycles() -> usize {
    std::env::var("TAUT_LEAK_CYCLES").map_or(CYCLES, |cycles| cycles.parse().unwrap())
}

/// Threads, descriptors, mappings of shared memory, and its files.
fn possessions() -> [usize; 4] {
    let count = |folder| std::fs::read_dir(folder).unwrap().count();
    let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
    let prefix = format!("taut_{DOMAIN}_");
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    [
        count("/proc/self/task"),
        count("/proc/self/fd"),
        maps.lines().filter(|line| line.contains("/dev/shm/")).count(),
        files.filter(|file| file.file_name().to_string_lossy().starts_with(&prefix)).count(),
    ]
}

fn live_once(log: &'static Log<u64>, value: u64) {
    let context = context(DOMAIN);
    let mut node = Node::create(context.clone(), "mayfly", "").unwrap();
    let numbers = node.subscribe::<Number>("/life", Qos::default()).unwrap();
    let publisher = node.create_publisher::<Number>("/life", Qos::default()).unwrap();
    let _timer = node.create_wall_timer(std::time::Duration::from_millis(1)).unwrap();
    let note = move |sample: tautline::Sample<Number>| async move { log.add(sample.value) };
    node.spawn_callback(CallbackOptions::other(), numbers.for_each(note)).unwrap();
    let before = log.events().len();
    let _spinning = spin(&context);
    publisher.publish(&Number { value }).unwrap();
    log.wait_for(before + 1);
}

/// The callback ends last, and with it its node and context, on its own thread.
fn end_on_the_callbacks_thread() {
    let context = context(DOMAIN);
    let node = Node::create(context.clone(), "own", "").unwrap();
    let helper = Node::create(context.clone(), "helper", "").unwrap();
    drop(context);
    let (ask, asked) = futures::channel::oneshot::channel();
    let owner = async move {
        let _node = node;
        asked.await.unwrap();
    };
    let callback = helper.spawn_callback(CallbackOptions::other(), owner).unwrap();
    drop(helper);
    assert!(!callback.is_finished());
    ask.send(()).unwrap();
    callback.join().unwrap();
}

#[test]
fn many_lives_leave_nothing() {
    static LOG: Log<u64> = Log::new();
    // iceoryx2 keeps one file per domain, which the first context makes.
    live_once(&LOG, 0);
    // A joined thread may stay listed for a moment.
    let settled = || (0..1000).map(|_| possessions()).min().unwrap();
    let before = settled();
    let cycles = cycles();
    (1..=cycles as u64).for_each(|value| live_once(&LOG, value));
    (0..cycles).for_each(|_| end_on_the_callbacks_thread());
    while possessions()[0] > before[0] {
        std::thread::yield_now();
    }
    assert_eq!(possessions(), before);
    assert_eq!(LOG.events(), (0..=cycles as u64).collect::<Vec<_>>());
}
