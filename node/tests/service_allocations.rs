// SPDX-License-Identifier: MIT OR Apache-2.0
//! A round trip in place allocates nothing: in the client, the
//! server and the sampler.
#![cfg(feature = "example_interfaces")]

mod common;
#[path = "../../msgs/tests/support/heap.rs"]
mod heap;

use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};

use common::context;
use futures::StreamExt;
use futures::executor::block_on;
use tautline::example_interfaces::srv::AddTwoInts;
use tautline::{CallbackOptions, Node, Qos};

/// Heap allocations of one thread.
static CLIENT: AtomicU64 = AtomicU64::new(0);
static SERVER: AtomicU64 = AtomicU64::new(0);
static SAMPLER: AtomicU64 = AtomicU64::new(0);

thread_local!(static MINE: Cell<Option<&'static AtomicU64>> = const { Cell::new(None) });

#[global_allocator]
static ALLOCATOR: heap::Watched = heap::Watched(|bytes| {
    if let (Some(_), Ok(Some(calls))) = (bytes, MINE.try_with(Cell::get)) {
        calls.fetch_add(1, Ordering::SeqCst);
    }
});

const ROUND_TRIPS: u64 = 10_000;

#[test]
fn ten_thousand_round_trips_allocate_nothing() {
    let ctx = context(159);
    let mut node = Node::create(ctx.clone(), "frugal", "").unwrap();
    let qos = Qos::default();
    let mut service = node.create_service::<AddTwoInts::Service>("frugal", qos).unwrap();
    let client = node.create_client::<AddTwoInts::Service>("frugal").unwrap();
    node.spawn_callback(CallbackOptions::other(), async move {
        while let Some(request) = service.next().await {
            let mut response = service.loan(&request).unwrap();
            response.sum = request.a + request.b;
            response.send().unwrap();
            // Before this the thread was setting up.
            MINE.set(Some(&SERVER));
        }
    })
    .unwrap();
    let sampler = std::thread::spawn({
        let ctx = ctx.clone();
        move || {
            MINE.set(Some(&SAMPLER));
            ctx.spin().unwrap();
            MINE.set(None);
        }
    });
    let round = |count: u64| {
        let before = [&CLIENT, &SERVER, &SAMPLER].map(|calls| calls.load(Ordering::SeqCst));
        // All in one task: entering `block_on` is no part of a round trip.
        block_on(async {
            for n in 0..count as i64 {
                let mut request = client.loan().unwrap();
                (request.a, request.b) = (n, 1);
                let response = client.send(request).unwrap().await.unwrap();
                assert_eq!(response.sum, n + 1);
            }
        });
        let after = [&CLIENT, &SERVER, &SAMPLER].map(|calls| calls.load(Ordering::SeqCst));
        std::array::from_fn::<_, 3, _>(|index| after[index] - before[index])
    };
    round(100);
    MINE.set(Some(&CLIENT));
    let allocations = round(ROUND_TRIPS);
    MINE.set(None);
    assert_eq!(allocations, [0; 3], "client, server, sampler");
    ctx.shutdown();
    sampler.join().unwrap();
}
