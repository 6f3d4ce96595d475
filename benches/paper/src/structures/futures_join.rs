// SPDX-License-Identifier: MIT OR Apache-2.0
//! `futures-join`: all callbacks joined into one task of a thread pool; the main thread samples.

use futures::executor::ThreadPool;
use futures::future::join_all;

use super::{Sampler, Spinner};
use crate::{Callback, PaperError};

pub fn run<S: Sampler>(
    mut spinner: Spinner<S>,
    callbacks: Vec<Callback>,
    ready: impl FnOnce(),
) -> Result<S, PaperError> {
    let pool = ThreadPool::new().map_err(|source| PaperError::Start { what: "a thread pool", source })?;
    pool.spawn_ok(async {
        join_all(callbacks).await;
    });
    ready();
    spinner.spin();
    Ok(spinner.sampler)
}
