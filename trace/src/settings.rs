// SPDX-License-Identifier: MIT OR Apache-2.0
//! The trace settings of a process.

use crate::error::TraceError;
use crate::layout::{MAX_EVENTS, MIN_EVENTS};

/// Whether this process records.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum TraceMode {
    /// Never. No ring is claimed.
    Off,
    /// While there is a recorder. Rings are claimed.
    #[default]
    Ready,
    /// From the start. Events that no recorder fetches in time are overwritten. The newest events of each thread remain,
    /// also after the process's end, until a recorder fetches them.
    On,
}

/// The trace settings of a process: when events are recorded, and how many of them a thread keeps.
///
/// ```
/// use tautline_trace::{TraceMode, TraceSettings};
/// let settings = TraceSettings::from(TraceMode::On).ring_events(1000);
/// assert_eq!(settings.ring_events, 1024);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct TraceSettings {
    /// Whether events are recorded.
    pub mode: TraceMode,
    /// The number of events in the ring of each thread, 40 bytes each: a power of two.
    pub ring_events: usize,
}

impl Default for TraceSettings {
    fn default() -> Self {
        TraceMode::default().into()
    }
}

impl From<TraceMode> for TraceSettings {
    fn from(mode: TraceMode) -> Self {
        TraceSettings { mode, ring_events: Self::RING_EVENTS }
    }
}

impl TraceSettings {
    /// The default size of a ring: 2048 events, 80 KiB.
    pub const RING_EVENTS: usize = 2048;

    /// Sets the events per ring, rounded up to a power of two from 16 to 1048576.
    #[must_use = "it returns the changed settings"]
    pub const fn ring_events(mut self, events: usize) -> Self {
        let events = if events < MIN_EVENTS { MIN_EVENTS } else { events };
        self.ring_events = if events > MAX_EVENTS { MAX_EVENTS } else { events.next_power_of_two() };
        self
    }

    /// `TAUT_TRACE` (`off`, `ready`, `on`) and `TAUT_TRACE_EVENTS` (events per ring).
    ///
    /// # Errors
    /// [`TraceError::Environment`] for an invalid value.
    pub fn of_environment() -> Result<TraceSettings, TraceError> {
        let mut settings = TraceSettings::default();
        if let Some(value) = variable("TAUT_TRACE") {
            settings.mode = match value.as_str() {
                "off" => TraceMode::Off,
                "ready" => TraceMode::Ready,
                "on" => TraceMode::On,
                _ => {
                    let (variable, expected) = ("TAUT_TRACE", "it may be 'off', 'ready' or 'on'");
                    return Err(TraceError::Environment { variable, value, expected });
                }
            };
        }
        if let Some(value) = variable("TAUT_TRACE_EVENTS") {
            let events = value.parse().ok().filter(|events| (MIN_EVENTS..=MAX_EVENTS).contains(events));
            let expected = "it is the number of events that each thread keeps, from 16 to 1048576";
            let refuse = || TraceError::Environment { variable: "TAUT_TRACE_EVENTS", value, expected };
            settings = settings.ring_events(events.ok_or_else(refuse)?);
        }
        Ok(settings)
    }
}

/// A variable that is set to something.
fn variable(name: &str) -> Option<String> {
    let value = std::env::var_os(name)?.to_string_lossy().into_owned();
    (!value.is_empty()).then_some(value)
}
