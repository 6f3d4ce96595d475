// SPDX-License-Identifier: MIT OR Apache-2.0
//! `futures-rt`, which the paper proposes: each callback in a thread of its own with a priority of its own; the main
//! thread samples at the highest.

use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use tautline_rt::{Policy, Realtime, ThreadBuilder};

use super::{Sampler, Spinner, thread_name};
use crate::{Callback, PaperError, Topic};

pub fn run<S: Sampler>(
    mut spinner: Spinner<S>,
    callbacks: Vec<Callback>,
    ready: impl FnOnce(),
    topics: &[Topic],
    realtime: Realtime,
) -> Result<S, PaperError> {
    for (topic, callback) in topics.iter().zip(callbacks) {
        let thread =
            ThreadBuilder::new(thread_name(topic)).policy(Policy::Fifo(topic.priority)).realtime(realtime);
        thread.spawn(move || {
            let mut pool = LocalPool::new();
            let _ = pool.spawner().spawn_local(callback);
            pool.run_until_stalled();
            move || pool.run()
        })?;
    }
    ready();
    spinner.spin();
    Ok(spinner.sampler)
}
