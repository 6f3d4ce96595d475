// SPDX-License-Identifier: MIT OR Apache-2.0
//! From publish to callback nothing is allocated, on the publishing thread, the sampler's and the callback's. All of it is
//! being traced.

mod common;
#[path = "../../msgs/tests/support/heap.rs"]
mod heap;

use std::cell::Cell;
use std::future::pending;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::channel;
use std::thread::{Thread, current, park};
use std::time::Duration;

use common::Number;
use futures::StreamExt;
use tautline::{CallbackOptions, Context, Node, Publisher, Qos, Realtime, Sample, TraceMode};
use tautline_rt::clock::monotonic_ns;
use tautline_trace::{Record, Recorder};

/// Heap calls of one thread.
struct Calls {
    allocations: AtomicU64,
    frees: AtomicU64,
}

impl Calls {
    const fn new() -> Calls {
        Calls { allocations: AtomicU64::new(0), frees: AtomicU64::new(0) }
    }

    fn now(&self) -> (u64, u64) {
        (self.allocations.load(Ordering::SeqCst), self.frees.load(Ordering::SeqCst))
    }
}

static PUBLISHER: Calls = Calls::new();
static SAMPLER: Calls = Calls::new();
static CALLBACK: Calls = Calls::new();

thread_local!(static MINE: Cell<Option<&'static Calls>> = const { Cell::new(None) });

#[global_allocator]
static ALLOCATOR: heap::Watched = heap::Watched(|bytes| {
    if let Ok(Some(calls)) = MINE.try_with(Cell::get) {
        let which = if bytes.is_some() { &calls.allocations } else { &calls.frees };
        which.fetch_add(1, Ordering::SeqCst);
    }
});

const MESSAGES: u64 = 10_000;

static RECEIVED: AtomicU64 = AtomicU64::new(0);
static WAITING: OnceLock<Thread> = OnceLock::new();

async fn answer(sample: Sample<Number>) {
    // Before this the thread was setting up.
    MINE.set(Some(&CALLBACK));
    RECEIVED.store(sample.value, Ordering::Release);
    if let Some(publisher) = WAITING.get() {
        publisher.unpark();
    }
}

/// Publishes each value when the one before has been received.
fn send(publisher: &Publisher<Number>, values: impl Iterator<Item = u64>) {
    for value in values {
        publisher.publish(&Number { value }).unwrap();
        while RECEIVED.load(Ordering::Acquire) < value {
            park();
        }
    }
}

/// Sends [`MESSAGES`]; returns each thread's allocations and frees meanwhile.
fn round(publisher: &Publisher<Number>, values: &mut impl Iterator<Item = u64>) -> [(u64, u64); 3] {
    let threads = [&PUBLISHER, &SAMPLER, &CALLBACK];
    let before = threads.map(Calls::now);
    send(publisher, values.take(MESSAGES as usize));
    let after = threads.map(Calls::now);
    std::array::from_fn(|index| (after[index].0 - before[index].0, after[index].1 - before[index].1))
}

#[test]
fn ten_thousand_messages_allocate_nothing() {
    allocate_nothing(CallbackOptions::other());
    // And where publishers wake the thread.
    RECEIVED.store(0, Ordering::Release);
    allocate_nothing(CallbackOptions::other().direct_wake());
}

fn allocate_nothing(options: CallbackOptions) {
    let context =
        Context::builder().domain(227).realtime(Realtime::Off).trace(TraceMode::On).build().unwrap();
    let mut node = Node::create(context.clone(), "frugal", "").unwrap();
    let publisher = node.create_publisher::<Number>("/frugal", Qos::default()).unwrap();
    let numbers = node.subscribe::<Number>("/frugal", Qos::default()).unwrap();
    let callback = node.spawn_callback(options, numbers.for_each(answer)).unwrap();
    // Two threads that are always ready need no sampler, and keep it from starting: only it serves a timer.
    let hour = Duration::from_secs(3_600);
    let mut timer = node.create_wall_timer_at(monotonic_ns(), hour).unwrap();
    let (sampler_serves, served) = channel();
    let waits = async move {
        timer.tick().await.unwrap();
        sampler_serves.send(()).unwrap();
        pending::<()>().await;
    };
    node.spawn_callback(CallbackOptions::other(), waits).unwrap();
    let sampler = std::thread::spawn({
        let context = context.clone();
        move || {
            MINE.set(Some(&SAMPLER));
            context.spin().unwrap();
            MINE.set(None);
        }
    });
    served.recv().unwrap();
    WAITING.get_or_init(current);
    MINE.set(Some(&PUBLISHER));
    let mut values = 1..;
    send(&publisher, values.by_ref().take(100));
    let rounds = [round(&publisher, &mut values), round(&publisher, &mut values)];
    MINE.set(None);
    assert_eq!(rounds, [[(0, 0); 3]; 2]);
    context.shutdown();
    sampler.join().unwrap();
    assert_eq!(callback.stats().releases(), 100 + 2 * MESSAGES);

    let mut events = 0;
    Recorder::start(227).unwrap().finish(&mut |record| match record {
        Record::Events { events: some, .. } => events += some.len() as u64,
        Record::Lost { events: some, .. } => events += some,
        _ => {}
    });
    assert!(events > 4 * 2 * MESSAGES, "{events}: publish, take, callback start and end of each");
}
