// SPDX-License-Identifier: MIT OR Apache-2.0
//! `futures`: one thread in which sampling and callbacks take turns.

use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;

use super::{Sampler, Spinner};
use crate::{Callback, PaperError};

pub fn run<S: Sampler>(
    mut spinner: Spinner<S>,
    callbacks: Vec<Callback>,
    ready: impl FnOnce(),
) -> Result<S, PaperError> {
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    callbacks.into_iter().for_each(|callback| drop(spawner.spawn_local(callback)));
    pool.run_until_stalled(); // moves the tasks in, which allocates
    ready();
    while spinner.turn() {
        pool.run_until_stalled();
    }
    Ok(spinner.sampler)
}
