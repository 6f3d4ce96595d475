// SPDX-License-Identifier: MIT OR Apache-2.0
//! `futures-2-threads`: one thread runs all callbacks; the main thread samples at a higher priority.

use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use tautline_rt::{Policy, Realtime, ThreadBuilder};

use super::{Sampler, Spinner};
use crate::{Callback, PaperError, priorities};

pub fn run<S: Sampler>(
    mut spinner: Spinner<S>,
    callbacks: Vec<Callback>,
    ready: impl FnOnce(),
    realtime: Realtime,
) -> Result<S, PaperError> {
    let thread = ThreadBuilder::new("callbacks").policy(Policy::Fifo(priorities::WORKER)).realtime(realtime);
    thread.spawn(move || {
        let mut pool = LocalPool::new();
        let spawner = pool.spawner();
        callbacks.into_iter().for_each(|callback| drop(spawner.spawn_local(callback)));
        pool.run_until_stalled();
        move || pool.run()
    })?;
    ready();
    spinner.spin();
    Ok(spinner.sampler)
}
