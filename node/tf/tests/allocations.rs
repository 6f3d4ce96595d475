// SPDX-License-Identifier: MIT OR Apache-2.0
//! A buffer allocates when it is made, what its limits say, and never after: counted per thread.

#[path = "../../../msgs/tests/support/heap.rs"]
mod heap;
mod support;

use std::cell::Cell;
use std::future::Future;
use std::pin::pin;
use std::task::{Context, Waker};

use support::at_x;
use tautline_tf::{Buffer, Kind, Limits, Time, TransformStamped};

thread_local! {
    static HEAP_CALLS: Cell<u64> = const { Cell::new(0) };
    static HEAP_BYTES: Cell<usize> = const { Cell::new(0) };
}

#[global_allocator]
static ALLOCATOR: heap::Watched = heap::Watched(|bytes| {
    let _ = HEAP_CALLS.try_with(|calls| calls.set(calls.get() + 1));
    let _ = HEAP_BYTES.try_with(|all| all.set(all.get() + bytes.unwrap_or_default()));
});

const CYCLES: i64 = 10_000;

#[test]
fn setting_looking_up_and_waiting_do_not_touch_the_heap() {
    let (mut writer, buffer) = Buffer::new(Limits { frames: 8, samples: 64, ..Limits::default() }).unwrap();
    let before = HEAP_CALLS.get();
    let mut found = 0;
    for stamp_ns in (0..CYCLES).map(|n| n * 2) {
        let set =
            |child, parent, stamp_ns| TransformStamped { parent, child, stamp_ns, transform: at_x(1.0) };
        // Each has the waits below waiting until its last transform is there.
        let mut wait = pin!(buffer.wait_for("map", "laser", Time::At(stamp_ns)).unwrap());
        let mut context = Context::from_waker(Waker::noop());
        assert!(wait.as_mut().poll(&mut context).is_pending());
        writer.set(&set("laser", "base", stamp_ns), Kind::Static).unwrap();
        writer.set(&set("odom", "map", stamp_ns), Kind::Dynamic).unwrap();
        writer.set(&set("base", "odom", stamp_ns), Kind::Dynamic).unwrap();
        writer.set(&set("base", "odom", stamp_ns - 1), Kind::Dynamic).ok();
        writer.set(&set("base", "odom", stamp_ns), Kind::Dynamic).unwrap_err();
        writer.set(&set("a name that has no place any more", "map", 0), Kind::Dynamic).ok();
        writer.set(&set("too", "many", 0), Kind::Dynamic).ok();
        writer.set(&set("frames", "set", 0), Kind::Dynamic).ok();
        found += i64::from(wait.as_mut().poll(&mut context).is_ready());
        found += i64::from(buffer.lookup("laser", "map", Time::Latest).is_ok());
        let (map, base) = (buffer.frame("map").unwrap(), buffer.frame("base").unwrap());
        found += i64::from(buffer.lookup_full(map, Time::At(stamp_ns), base, Time::Latest, "odom").is_ok());
        found += i64::from(buffer.lookup(map, base, Time::At(stamp_ns + 1)).is_err());
        found += i64::from(buffer.lookup("map", "nobody", Time::Latest).is_err());
        found += i64::from(!buffer.can_transform("map", "laser", Time::At(-1)));
        found += i64::from(buffer.counters().set > 0);
        if stamp_ns % 2_000 == 1_000 {
            writer.clear();
        }
    }
    let calls = HEAP_CALLS.get() - before;
    assert_eq!(calls, 0);
    assert!(found > 6 * CYCLES, "{found}");
}

#[test]
fn the_memory_of_a_buffer_is_what_its_limits_say() {
    for limits in [
        Limits::default(),
        Limits { frames: 2, samples: 3, waiters: 0, ..Limits::default() },
        Limits { frames: 100, samples: 16, waiters: 7, ..Limits::default() },
    ] {
        let before = HEAP_BYTES.get();
        let made = Buffer::new(limits).unwrap();
        let bytes = HEAP_BYTES.get() - before;
        assert_eq!(bytes, limits.bytes());
        drop(made);
    }
    println!("{} bytes by default", Limits::default().bytes());
}
