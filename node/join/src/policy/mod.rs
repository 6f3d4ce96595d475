// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which messages belong together, decided from their stamps, and by [`LatestTime`] from the rates at which they come.

mod approximate;
mod epsilon;
mod exact;
mod latest_time;

pub use approximate::ApproximateTime;
pub use epsilon::ApproximateEpsilonTime;
pub use exact::ExactTime;
pub use latest_time::{LatestTime, RateConfig};

/// Decides which of the messages that wait are a set. It sees stamps in nanoseconds; whoever calls it keeps the messages, one queue for
/// each input, and does to them what it says.
pub trait Policy {
    /// Most messages of one input that wait.
    fn queue_size(&self) -> usize;

    /// Makes room for so many inputs, all empty.
    fn start(&mut self, inputs: usize);

    /// A message has come.
    fn arrived(&mut self, input: usize, stamp_ns: i64) -> Arrival;

    /// Decides on what has come. It calls `drop` for each input whose oldest message is to be dropped, in this order; `true`: the
    /// oldest messages of all inputs are a set, which is to be taken; then it is to be called again.
    fn decide(&mut self, drop: &mut dyn FnMut(usize)) -> bool;

    /// Forgets all that waits.
    fn clear(&mut self);
}

/// What is to be done with a message that has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// It waits, with so many messages of its input before it.
    Wait(usize),
    /// As the last of its input, and it came sooner after the one before than was promised.
    WaitTooClose(usize),
    /// It is dropped.
    Refuse,
}

fn nanos(duration: std::time::Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}
