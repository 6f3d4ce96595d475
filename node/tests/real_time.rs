// SPDX-License-Identifier: MIT OR Apache-2.0
//! In a real-time thread, reading parameters and logging allocates and frees nothing.

mod common;
#[path = "../../msgs/tests/support/heap.rs"]
mod heap;

use std::cell::Cell;
use std::hint::black_box;
use std::time::Duration;

use common::{context, realtime};
use tautline::logging::{flush, lost_lines};
use tautline::{Node, log_debug, log_info, log_warn};
use tautline_rt::{Policy, ThreadBuilder};

thread_local!(static CALLS: Cell<Option<u64>> = const { Cell::new(None) });

#[global_allocator]
static ALLOCATOR: heap::Watched = heap::Watched(|_| {
    let _ = CALLS.try_with(|calls| calls.set(calls.get().map(|calls| calls + 1)));
});

#[test]
fn parameters_and_lines_cost_no_heap_calls() {
    if !realtime() {
        return;
    }
    let mut node = Node::create(context(61), "control", "/robot").unwrap();
    let mut gain = node.declare_parameter("gain", 1.5).unwrap();
    let mut gains = node.declare_parameter("gains", vec![0.5; 16]).unwrap();
    let mut frame = node.declare_parameter("frame", "base_link".to_owned()).unwrap();
    let logger = node.logger().clone();
    let parameters = node.parameters().clone();
    let (begin, set) = std::sync::mpsc::channel();
    let control = ThreadBuilder::new("cb:control").policy(Policy::Fifo(30)).spawn(move || {
        move || {
            begin.send(()).unwrap();
            CALLS.set(Some(0));
            for round in 0..10_000_u64 {
                black_box((gain.get(), gains.read().len(), frame.read().len()));
                log_debug!(logger, "not wanted");
                log_info!(logger, "round {round} in {}, {:.3}", frame.read(), gain.get());
                log_warn!("another", "by its name");
                log_info!(logger.throttle(Duration::from_secs(1)), "now and then");
            }
            CALLS.take().unwrap()
        }
    });
    set.recv().unwrap();
    // Values are replaced, and so dropped, in this thread meanwhile.
    for round in 0..200 {
        parameters.set("gains", vec![f64::from(round); 16]).unwrap();
        parameters.set("frame", format!("frame {round}")).unwrap();
    }
    assert_eq!(control.unwrap().join().unwrap(), 0);
    flush();
    assert!(lost_lines() > 0, "more was logged than can be written");
}
