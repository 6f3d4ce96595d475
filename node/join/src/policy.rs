// SPDX-License-Identifier: MIT OR Apache-2.0
//! Decides which messages belong together: by their stamps, or with [`LatestTime`](crate::LatestTime) by the rates at which they arrive.

/// Decides which of the waiting messages form a set. It sees only stamps in nanoseconds. The caller keeps the messages, one queue for
/// each input, and carries out the decisions.
pub trait Policy {
    /// Maximum of waiting messages of one input.
    fn queue_size(&self) -> usize;

    /// Starts with this number of inputs, all empty, and reserves their memory.
    fn start(&mut self, inputs: usize);

    /// Handles the stamp of a message that has arrived.
    fn arrived(&mut self, input: usize, stamp_ns: i64) -> Arrival;

    /// Decides on the messages that have arrived. Calls `drop` for each input whose oldest message is to be dropped, in this order;
    /// `true`: the oldest messages of all inputs are a set, which the caller takes before it calls this again.
    fn decide(&mut self, drop: &mut dyn FnMut(usize)) -> bool;

    /// Removes all waiting messages.
    fn clear(&mut self);
}

/// What to do with a message that has arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// It waits, with this number of messages of its input before it.
    Wait(usize),
    /// It waits as the last of its input, but followed the previous one sooner than guaranteed.
    WaitTooClose(usize),
    /// It is dropped.
    Refuse,
}

pub(crate) fn nanos(duration: std::time::Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}
