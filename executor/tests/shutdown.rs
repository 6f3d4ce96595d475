// SPDX-License-Identifier: MIT OR Apache-2.0
//! Shutting down leaves no thread. Alone in its file: it counts the threads of the process.

use std::future::pending;

use tautline_executor::{CallbackGroup, CallbackOptions, Executor, Realtime};
use tautline_rt::threads;

/// A joined thread may stay listed for a moment: until then this turns, and a leaked one makes it turn for ever.
fn wait_for_threads(count: usize) {
    while threads().unwrap().len() != count {
        std::thread::yield_now();
    }
}

#[test]
fn shutdown_and_drop_join_every_thread() {
    let before = threads().unwrap().len();
    let spawn_some = || {
        let executor = Executor::new(Realtime::Off);
        for _ in 0..5 {
            executor.spawn_callback(CallbackOptions::other(), pending()).unwrap();
        }
        let mut group = CallbackGroup::new();
        group.add("never", futures::stream::pending::<()>(), |()| 0, |()| async {});
        executor.spawn_group(CallbackOptions::other(), group).unwrap();
        assert_eq!(threads().unwrap().len(), before + 6);
        executor
    };
    spawn_some().shutdown().unwrap();
    wait_for_threads(before);
    drop(spawn_some());
    wait_for_threads(before);
}
