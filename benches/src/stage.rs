// SPDX-License-Identifier: MIT OR Apache-2.0

use std::panic::resume_unwind;
use tautline::{CallbackHandle, Context, ContextBuilder, CoreSet, Realtime, Result};
use tautline_rt::permission::realtime_permitted;

/// Where callbacks are measured in this process: a context whose sampler has the same core as they, and another core for what
/// goes on beside. Real-time priorities if this user may have them.
pub struct Stage {
    /// Of the nodes.
    pub context: Context,
    /// The sampler's, and for the callbacks.
    pub core: usize,
    /// For the rest; the same if there is no other.
    pub other_core: usize,
    /// Whether threads get their priorities.
    pub realtime: bool,
}

impl Stage {
    pub fn new() -> Result<Self> {
        Stage::with(Context::builder())
    }

    /// With a context of other settings.
    pub fn with(builder: ContextBuilder) -> Result<Self> {
        let cores: Vec<usize> = CoreSet::allowed()?.iter().collect();
        let (core, other_core) = (cores[cores.len() - 1], cores[0]);
        let realtime = realtime_permitted(ContextBuilder::SAMPLER_PRIORITY).is_ok();
        let mode = if realtime { Realtime::Required } else { Realtime::Off };
        let context = builder.realtime(mode).sampler_core(core).build()?;
        Ok(Stage { context, core, other_core, realtime })
    }

    /// Why what is measured here cannot be judged: without priorities or a second core it depends on anything.
    pub fn unfit(&self) -> Option<String> {
        let is_fit = self.realtime && self.core != self.other_core;
        (!is_fit).then(|| "takes real-time priorities and two cores".to_owned())
    }

    /// Spins while `measure` runs; then ends the context and the callbacks.
    pub fn spin_while<T>(&self, callbacks: Vec<CallbackHandle>, measure: impl FnOnce() -> T) -> Result<T> {
        let context = self.context.clone();
        let sampler = std::thread::spawn(move || context.spin());
        let measured = measure();
        self.context.shutdown();
        sampler.join().unwrap_or_else(|panic| resume_unwind(panic))?;
        for callback in callbacks {
            callback.stop();
            callback.join()?;
        }
        Ok(measured)
    }
}
