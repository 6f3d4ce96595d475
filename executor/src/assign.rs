// SPDX-License-Identifier: MIT OR Apache-2.0
//! Assigns priorities by periods or deadlines.
//!
//! ```
//! # use std::time::Duration;
//! let deadlines = [20, 5].map(Duration::from_millis);
//! assert_eq!(tautline_executor::assign::deadline_monotonic(&deadlines, 30)?, [29, 30]);
//! # Ok::<(), tautline_executor::ExecutorError>(())
//! ```

use std::time::Duration;

use crate::ExecutorError;

/// Rate-monotonic priorities: the shortest period gets `highest`, each longer period the next lower priority; equal
/// periods share one. The result is in the order of `periods`.
///
/// Optimal among fixed priorities when every deadline is its period (Liu & Layland 1973).
///
/// # Errors
/// [`ExecutorError::TooFewPriorities`] if it would go below 1, [`ExecutorError::BadHighest`] outside 1..=99.
///
/// ```
/// # use std::time::Duration;
/// let periods = [100, 10, 50, 10].map(Duration::from_millis);
/// assert_eq!(tautline_executor::assign::rate_monotonic(&periods, 20)?, [18, 20, 19, 20]);
/// # Ok::<(), tautline_executor::ExecutorError>(())
/// ```
pub fn rate_monotonic(periods: &[Duration], highest: u8) -> Result<Vec<u8>, ExecutorError> {
    shortest_first(periods, highest)
}

/// Deadline-monotonic priorities: the shortest relative deadline gets `highest`, as in [`rate_monotonic`].
///
/// Optimal among fixed priorities when deadlines are at most the periods (Leung & Whitehead 1982).
///
/// # Errors
/// As [`rate_monotonic`].
pub fn deadline_monotonic(deadlines: &[Duration], highest: u8) -> Result<Vec<u8>, ExecutorError> {
    shortest_first(deadlines, highest)
}

fn shortest_first(times: &[Duration], highest: u8) -> Result<Vec<u8>, ExecutorError> {
    if !(1..=99).contains(&highest) {
        return Err(ExecutorError::BadHighest { highest });
    }
    let mut levels = times.to_vec();
    levels.sort_unstable();
    levels.dedup();
    if levels.len() > usize::from(highest) {
        return Err(ExecutorError::TooFewPriorities { levels: levels.len(), highest });
    }
    let level = |time| levels.partition_point(|shorter| shorter < time);
    // At most `highest` levels: the subtraction stays at 1 or above.
    Ok(times
        .iter()
        .map(|time| highest.saturating_sub(u8::try_from(level(time)).unwrap_or(highest)))
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_task_set() {
        let periods = [10, 20, 50, 100, 200].map(Duration::from_millis);
        assert_eq!(rate_monotonic(&periods, 20).unwrap(), [20, 19, 18, 17, 16]);
        assert_eq!(deadline_monotonic(&periods, 5).unwrap(), [5, 4, 3, 2, 1]);
        assert!(rate_monotonic(&[], 1).unwrap().is_empty());
    }

    #[test]
    fn priorities_never_go_below_1() {
        let periods = [3, 1, 2, 2].map(Duration::from_millis);
        assert_eq!(rate_monotonic(&periods, 3).unwrap(), [1, 3, 2, 2]);
        let error = rate_monotonic(&periods, 2).unwrap_err();
        assert!(matches!(error, ExecutorError::TooFewPriorities { levels: 3, highest: 2 }), "{error}");
        for highest in [0, 100] {
            assert!(matches!(rate_monotonic(&periods, highest), Err(ExecutorError::BadHighest { .. })));
        }
    }
}
