// SPDX-License-Identifier: MIT OR Apache-2.0
//! The sampler's wake and the tasks' polls allocate nothing. A file of its own: it replaces the allocator.

#[path = "../../transport/tests/support/mod.rs"]
mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::task::Context;
use std::time::Duration;
use support::{Count, domain};
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::{Sampler, Timer};
use tautline_transport::{Limits, Participant, Qos};

const CYCLES: u64 = 10_000;

/// Counts what the current thread allocates or frees.
struct Counting;

thread_local!(static CALLS: Cell<usize> = const { Cell::new(0) });

// SAFETY: System does the work; counting touches a plain thread-local that needs no destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        CALLS.set(CALLS.get() + 1);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        CALLS.set(CALLS.get() + 1);
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn wake_and_poll() {
    tautline_trace::configure(tautline_trace::TraceMode::On.into());
    let participant = Participant::new(domain(188)).unwrap();
    let mut sampler = Sampler::new(&participant).unwrap();
    let limits = Limits::default();
    let publisher = participant.create_publisher::<Count>("/heap", Qos::default(), limits).unwrap();
    let subscription = participant.create_subscription::<Count>("/heap", Qos::default(), limits).unwrap();
    let mut condition = sampler.events().guard_condition().unwrap();
    let mut timers: Vec<_> = [10, 70, 300]
        .map(|micros| {
            Timer::starting_at(sampler.events(), monotonic_ns(), Duration::from_micros(micros)).unwrap()
        })
        .into();
    // A real waker, counted references and all.
    let pool = futures::executor::LocalPool::new();
    let (send, receive) = std::sync::mpsc::channel();
    futures::task::LocalSpawnExt::spawn_local(
        &pool.spawner(),
        std::future::poll_fn(move |context| {
            send.send(context.waker().clone()).unwrap();
            std::task::Poll::Pending
        }),
    )
    .unwrap();
    let mut pool = pool;
    pool.run_until_stalled();
    let waker = receive.recv().unwrap();
    let mut context = Context::from_waker(&waker);

    let (mut calls, mut events, mut ticks) = (0, 0, 0);
    for n in 0..CYCLES + 1 {
        publisher.publish(&Count { n }).unwrap();
        condition.trigger();
        let before = CALLS.get();
        events += sampler.spin_once(Some(Duration::from_micros(20)));
        assert!(condition.poll_triggered(&mut context).is_ready());
        assert!(condition.poll_triggered(&mut context).is_pending());
        assert!(subscription.poll_take(&mut context).is_ready());
        assert!(subscription.poll_take(&mut context).is_pending());
        ticks += timers
            .iter_mut()
            .map(|timer| usize::from(timer.poll_tick(&mut context).is_ready()))
            .sum::<usize>();
        if n % 100 == 0 {
            // A wait that ends with a timer.
            events += sampler.spin_once(None);
        }
        // The first take maps the publisher's memory.
        calls += if n == 0 { 0 } else { CALLS.get() - before };
    }
    assert!(events as u64 >= 2 * CYCLES && ticks > 100, "{events} events, {ticks} ticks");
    assert_eq!(calls, 0);

    // It was all traced. Fetched, so that no file of it stays.
    let mut fetched = 0;
    tautline_trace::Recorder::start(188).unwrap().finish(&mut |record| {
        if let tautline_trace::Record::Events { events, .. } = record {
            fetched += events.len();
        }
    });
    assert!(fetched > 1000, "{fetched} events");
}
