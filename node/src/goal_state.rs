// SPDX-License-Identifier: MIT OR Apache-2.0
//! The states of a goal, as in ROS 2's action design.
//!
//! ```text
//!               execute              succeed
//!    ACCEPTED ----------> EXECUTING ---------> SUCCEEDED
//!        |                    |  \   abort
//!        | cancel goal        |   +----------> ABORTED
//!        v                    | cancel goal
//!    CANCELING <--------------+
//!        |  canceled                succeed: SUCCEEDED, abort: ABORTED
//!        +----------> CANCELED
//! ```

use std::sync::Arc;
use std::sync::atomic::{AtomicI8, Ordering};

/// The status of a goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum GoalStatus {
    /// There is no such goal, or its status is not known yet.
    Unknown,
    /// Accepted, but not executing yet.
    Accepted,
    /// It is executing.
    Executing,
    /// It is being cancelled.
    Canceling,
    /// It succeeded.
    Succeeded,
    /// It was cancelled.
    Canceled,
    /// It was aborted.
    Aborted,
}

/// The status of one goal, which its handles read without a lock. A clone is the same status.
#[derive(Clone, Default)]
pub(crate) struct SharedStatus(Arc<AtomicI8>);

impl SharedStatus {
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn get(&self) -> GoalStatus {
        // Acquire: pairs with the Release in `set`.
        GoalStatus::from_rcl(self.0.load(Ordering::Acquire))
    }

    /// Called under the lock of the goal's owner, because the new status depends on the old one.
    pub(crate) fn set(&self, status: GoalStatus) {
        self.0.store(status.to_rcl(), Ordering::Release);
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum GoalEvent {
    Execute,
    CancelGoal,
    Succeed,
    Abort,
    Canceled,
}

impl GoalStatus {
    /// The number in ROS 2's messages.
    pub fn to_rcl(&self) -> i8 {
        *self as i8
    }

    /// The status for the number in ROS 2's messages; [`Unknown`](Self::Unknown) for an invalid number.
    pub fn from_rcl(s: i8) -> Self {
        use GoalStatus::{Aborted, Accepted, Canceled, Canceling, Executing, Succeeded, Unknown};
        let all = [Unknown, Accepted, Executing, Canceling, Succeeded, Canceled, Aborted];
        usize::try_from(s).ok().and_then(|index| all.get(index)).copied().unwrap_or(Unknown)
    }

    /// Whether the status is final.
    pub fn is_terminal(&self) -> bool {
        matches!(self, GoalStatus::Succeeded | GoalStatus::Canceled | GoalStatus::Aborted)
    }

    /// The status after `event`; `None` if the event cannot happen in this status.
    pub(crate) fn after(self, event: GoalEvent) -> Option<Self> {
        match (self, event) {
            (Self::Accepted, GoalEvent::Execute) => Some(Self::Executing),
            (Self::Accepted | Self::Executing, GoalEvent::CancelGoal) => Some(Self::Canceling),
            (Self::Executing | Self::Canceling, GoalEvent::Succeed) => Some(Self::Succeeded),
            (Self::Executing | Self::Canceling, GoalEvent::Abort) => Some(Self::Aborted),
            (Self::Canceling, GoalEvent::Canceled) => Some(Self::Canceled),
            _ => None,
        }
    }
}

tautline_rt::names!(GoalStatus: Display {
    Unknown: "unknown", Accepted: "accepted", Executing: "executing", Canceling: "canceling",
    Succeeded: "succeeded", Canceled: "canceled", Aborted: "aborted",
});

#[cfg(test)]
mod tests {
    use super::*;
    use GoalEvent::{Abort, CancelGoal, Execute, Succeed};
    use GoalStatus::{Aborted, Accepted, Canceled, Canceling, Executing, Succeeded, Unknown};

    #[test]
    fn every_transition() {
        let states = [Unknown, Accepted, Executing, Canceling, Succeeded, Canceled, Aborted];
        let events = [Execute, CancelGoal, Succeed, Abort, GoalEvent::Canceled];
        let possible = [
            (Accepted, Execute, Executing),
            (Accepted, CancelGoal, Canceling),
            (Executing, CancelGoal, Canceling),
            (Executing, Succeed, Succeeded),
            (Executing, Abort, Aborted),
            (Canceling, GoalEvent::Canceled, Canceled),
            (Canceling, Succeed, Succeeded),
            (Canceling, Abort, Aborted),
        ];
        for state in states {
            for event in events {
                let expected =
                    possible.iter().find(|(from, by, _)| (*from, *by) == (state, event)).map(|(.., to)| *to);
                assert_eq!(state.after(event), expected, "{state:?} {event:?}");
            }
            assert_eq!(state.is_terminal(), [Succeeded, Canceled, Aborted].contains(&state));
            assert_eq!(GoalStatus::from_rcl(state.to_rcl()), state);
        }
        assert_eq!([-1, 7, i8::MAX].map(GoalStatus::from_rcl), [Unknown; 3]);
        assert_eq!((Accepted.to_rcl(), Aborted.to_rcl()), (1, 6), "action_msgs/msg/GoalStatus");
    }
}
