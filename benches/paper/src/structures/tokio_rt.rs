// SPDX-License-Identifier: MIT OR Apache-2.0
//! `tokio-rt`: Tokio runs the callbacks, its workers below the thread that samples.

use ::tokio::runtime::Builder;
use tautline_rt::{Policy, Realtime, set_policy};

use super::{Sampler, Spinner, tokio};
use crate::{Callback, PaperError, priorities};

pub fn run<S: Sampler>(
    spinner: Spinner<S>,
    callbacks: Vec<Callback>,
    ready: impl FnOnce(),
    realtime: Realtime,
) -> Result<S, PaperError> {
    let mut builder = Builder::new_multi_thread();
    if realtime == Realtime::Required {
        builder.on_thread_start(|| {
            // Refused only if this process could not have its own, higher priority either.
            let _ = set_policy(Policy::Fifo(priorities::WORKER));
        });
    }
    let runtime = builder.build().map_err(|source| PaperError::Start { what: "Tokio", source })?;
    tokio::spawn_and_spin(runtime, spinner, callbacks, ready)
}
