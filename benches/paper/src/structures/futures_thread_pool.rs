// SPDX-License-Identifier: MIT OR Apache-2.0
//! `futures-thread-pool`: a thread pool of two runs the callbacks; the main thread samples.

use futures::executor::ThreadPool;

use super::{Sampler, Spinner};
use crate::{Callback, PaperError};

pub fn run<S: Sampler>(
    mut spinner: Spinner<S>,
    callbacks: Vec<Callback>,
    ready: impl FnOnce(),
) -> Result<S, PaperError> {
    let pool = ThreadPool::builder().pool_size(2).create();
    let pool = pool.map_err(|source| PaperError::Start { what: "a thread pool", source })?;
    callbacks.into_iter().for_each(|callback| pool.spawn_ok(callback));
    ready();
    spinner.spin();
    Ok(spinner.sampler)
}
