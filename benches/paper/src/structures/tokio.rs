// SPDX-License-Identifier: MIT OR Apache-2.0
//! `tokio`: Tokio as it comes runs the callbacks, a thread of its own samples; all of them have one priority.

use std::thread;

use tokio::runtime::{Builder, Runtime};

use super::{Sampler, Spinner};
use crate::{Callback, PaperError};

pub fn run<S: Sampler>(
    spinner: Spinner<S>,
    callbacks: Vec<Callback>,
    ready: impl FnOnce(),
) -> Result<S, PaperError> {
    let runtime = Builder::new_multi_thread().build();
    let runtime = runtime.map_err(|source| PaperError::Start { what: "Tokio", source })?;
    spawn_and_spin(runtime, spinner, callbacks, ready)
}

/// Gives the callbacks to Tokio and samples in another thread until the run is over.
pub fn spawn_and_spin<S: Sampler>(
    runtime: Runtime,
    mut spinner: Spinner<S>,
    callbacks: Vec<Callback>,
    ready: impl FnOnce(),
) -> Result<S, PaperError> {
    callbacks.into_iter().for_each(|callback| drop(runtime.spawn(callback)));
    ready();
    let sampler = thread::Builder::new().name("sampler".into()).spawn(move || {
        spinner.spin();
        spinner.sampler
    });
    let sampler = sampler.map_err(|source| PaperError::Start { what: "a thread", source })?;
    let sampler = sampler.join().map_err(|_| PaperError::Panicked);
    // Callbacks never end by themselves.
    runtime.shutdown_background();
    sampler
}
