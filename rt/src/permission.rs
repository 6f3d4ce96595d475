// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why the kernel refuses a real-time priority, and how to fix it.

pub use crate::refusal::{cpu_group, cpu_group_folder, diagnose};
use crate::{Policy, RtError, ThreadBuilder};

/// Checks whether this process may use `SCHED_FIFO` at `priority`, by using it on a short-lived thread.
///
/// # Errors
/// [`RtError::BadPriority`] outside 1..=99; else the variant that names the fix, as [`diagnose`].
pub fn realtime_permitted(priority: u8) -> Result<(), RtError> {
    ThreadBuilder::new("rt-probe").policy(Policy::Fifo(priority)).spawn(|| || ())?.join()
}

/// Returns what a test needs of the machine, such as [`realtime_permitted`]; if it is missing, prints that the test is skipped: `None`.
///
/// # Panics
/// If it is not there and `CI` is set.
#[doc(hidden)]
pub fn test_needs<T>(needed: Result<T, impl std::fmt::Display>) -> Option<T> {
    let there = needed.inspect_err(|missing| {
        assert!(std::env::var_os("CI").is_none(), "{missing}");
        println!("skipped: {missing}");
    });
    there.ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_priority_out_of_range_is_not_a_matter_of_permission() {
        assert!(matches!(realtime_permitted(0), Err(RtError::BadPriority { priority: 0 })));
        assert!(matches!(realtime_permitted(100), Err(RtError::BadPriority { priority: 100 })));
    }
}
