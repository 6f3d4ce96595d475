// SPDX-License-Identifier: MIT OR Apache-2.0
//! End-to-end bounds of chains, computed from the bounds of their stages.

/// One stage of a chain whose stages run at their own pace and read the latest value of the one before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stage {
    /// Time between two releases of the stage.
    pub period_ns: u64,
    /// Its response time, from the nominal release. If the stage triggers further stages, this includes their
    /// latency.
    pub response_ns: u64,
}

/// Latency of a chain in which each stage triggers the next: the sum of the response times, each counted from the
/// arrival of the message that triggers it. `None` on overflow.
///
/// ```
/// assert_eq!(tautline_analysis::chain::event_triggered(&[2, 6, 13]), Some(21));
/// ```
pub fn event_triggered(responses_ns: &[u64]) -> Option<u64> {
    responses_ns.iter().try_fold(0, |sum: u64, response| sum.checked_add(*response))
}

/// Reaction time of a chain through registers: from an event outside, just missed by the first stage, to the end of the
/// first job of the last stage that reflects it: the sum of (T + R) (Davare et al. 2007). `None` on overflow.
///
/// ```
/// use tautline_analysis::chain::{Stage, data_age, register_sampled};
/// let stages = [(10, 2), (20, 6), (50, 13)].map(|(period_ns, response_ns)| Stage { period_ns, response_ns });
/// assert_eq!(register_sampled(&stages), Some(101));
/// assert_eq!(data_age(&stages), Some(51));
/// ```
pub fn register_sampled(stages: &[Stage]) -> Option<u64> {
    stages.iter().try_fold(0, |sum: u64, s| sum.checked_add(s.period_ns)?.checked_add(s.response_ns))
}

/// Data age of a chain through registers: the age of a value that the first stage read, at the end of the last
/// stage's job that uses it. `None` on overflow.
///
/// A job released at r reads what the latest job of the stage before has written that ended by r, which was released
/// later than r - (T + R): had it not been, its successor would have ended by r, too. The last stage adds its R. (Until
/// the next output replaces it, the value ages by one more period of the last stage.)
pub fn data_age(stages: &[Stage]) -> Option<u64> {
    let last = stages.last().map_or(0, |stage| stage.period_ns);
    register_sampled(stages)?.checked_sub(last)
}
