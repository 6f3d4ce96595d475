// SPDX-License-Identifier: MIT OR Apache-2.0
//! A server's goals: their states, which of them may be cancelled, which requests wait for a result, and which goals have expired.
//! No input or output.

use crate::goal_state::{GoalEvent, GoalStatus, SharedStatus};
use std::time::Duration;
use tautline_msgs::GoalId;
use tautline_transport::MAX_PENDING_REQUESTS;

/// Means every goal in a request to cancel.
const ANY: GoalId = [0; 16];

/// Maximum of requests that wait for one goal's result: as many as 32 clients, a service's default maximum, can have pending at
/// once.
pub(crate) const MAX_WAITING: usize = 32 * MAX_PENDING_REQUESTS;

/// Return codes of a request to cancel, from `action_msgs/srv/CancelGoal`.
pub(crate) mod cancel_code {
    pub const NONE: i8 = 0;
    pub const REJECTED: i8 = 1;
    pub const UNKNOWN_GOAL_ID: i8 = 2;
    pub const GOAL_TERMINATED: i8 = 3;
}

/// Seconds and nanoseconds.
pub(crate) type Stamp = (i32, u32);

/// `W` is a waiting request for a result.
pub(crate) struct Goals<W> {
    list: Vec<Goal<W>>,
    /// How long a result is kept.
    result_timeout: Duration,
}

struct Goal<W> {
    id: GoalId,
    status: SharedStatus,
    accepted: Stamp,
    /// The body of the response, and when it arrived, on the monotonic clock.
    result: Option<(Vec<u8>, u64)>,
    waiting: Vec<W>,
}

/// The reply to a request for a result.
pub(crate) enum ResultOf<W> {
    /// The body of the response.
    Known(W, Vec<u8>),
    Unknown(W),
    Later,
    TooMany(W),
}

impl<W> Goals<W> {
    pub(crate) fn new(result_timeout: Duration) -> Self {
        Goals { list: Vec::new(), result_timeout }
    }

    /// Adds an accepted goal. Returns its status, which follows later changes.
    ///
    /// # Errors
    /// A goal with this id exists already: its status.
    pub(crate) fn accept(&mut self, id: GoalId, accepted: Stamp) -> Result<SharedStatus, GoalStatus> {
        if let Some(goal) = self.get(id) {
            return Err(goal.status.get());
        }
        let status = SharedStatus::default();
        status.set(GoalStatus::Accepted);
        self.list.push(Goal { id, status: status.clone(), accepted, result: None, waiting: Vec::new() });
        Ok(status)
    }

    pub(crate) fn status(&self, id: GoalId) -> GoalStatus {
        self.list.iter().find(|goal| goal.id == id).map_or(GoalStatus::Unknown, |goal| goal.status.get())
    }

    /// Applies an event to a goal. Returns the status after the event.
    ///
    /// # Errors
    /// The status in which the event cannot happen.
    pub(crate) fn apply(&mut self, id: GoalId, event: GoalEvent) -> Result<GoalStatus, GoalStatus> {
        let Some(goal) = self.get(id) else { return Err(GoalStatus::Unknown) };
        let before = goal.status.get();
        let status = before.after(event).ok_or(before)?;
        goal.status.set(status);
        Ok(status)
    }

    /// Stores the result of a terminal goal. Returns the requests that wait for it.
    pub(crate) fn finish(&mut self, id: GoalId, body: Vec<u8>, now_ns: u64) -> Vec<W> {
        let Some(goal) = self.get(id) else { return Vec::new() };
        goal.result = Some((body, now_ns));
        std::mem::take(&mut goal.waiting)
    }

    /// Handles a request for a result. If the maximum of requests wait for it, those whose client is not `there` any more are removed;
    /// if that is not enough, the reply is that the goal is unknown.
    pub(crate) fn request_result(
        &mut self,
        id: GoalId,
        who: W,
        there: impl FnMut(&W) -> bool,
    ) -> ResultOf<W> {
        match self.get(id) {
            None => ResultOf::Unknown(who),
            Some(Goal { result: Some((body, _)), .. }) => ResultOf::Known(who, body.clone()),
            Some(goal) => {
                if goal.waiting.len() >= MAX_WAITING {
                    goal.waiting.retain(there);
                }
                if goal.waiting.len() >= MAX_WAITING {
                    return ResultOf::TooMany(who);
                }
                goal.waiting.push(who);
                ResultOf::Later
            }
        }
    }

    /// The goals that a request to cancel selects, and the return code if there are none. As in ROS 2: no id and no time select all;
    /// a time selects all accepted until then; an id selects that goal in addition.
    pub(crate) fn to_cancel(&self, id: GoalId, until: Stamp) -> (Vec<GoalId>, i8) {
        let all = id == ANY && until == (0, 0);
        let meant = |goal: &Goal<W>| {
            all || (id != ANY && goal.id == id) || (until != (0, 0) && goal.accepted <= until)
        };
        let can = |goal: &Goal<W>| goal.status.get().after(GoalEvent::CancelGoal).is_some();
        let goals: Vec<_> =
            self.list.iter().filter(|goal| meant(goal) && can(goal)).map(|goal| goal.id).collect();
        let code = match self.status(id) {
            _ if id == ANY || !goals.is_empty() => cancel_code::NONE,
            GoalStatus::Unknown => cancel_code::UNKNOWN_GOAL_ID,
            _ => cancel_code::GOAL_TERMINATED,
        };
        (goals, code)
    }

    /// Removes the goals whose results were kept for longer than the time-out. Returns whether there were any.
    pub(crate) fn expire(&mut self, now_ns: u64) -> bool {
        let limit_ns = tautline_rt::clock::nanoseconds(self.result_timeout);
        let before = self.list.len();
        self.list.retain(|goal| {
            goal.result.as_ref().is_none_or(|(_, since_ns)| now_ns.saturating_sub(*since_ns) < limit_ns)
        });
        self.list.len() < before
    }

    /// All goals, with time of acceptance and status.
    pub(crate) fn all(&self) -> impl Iterator<Item = (GoalId, Stamp, GoalStatus)> {
        self.list.iter().map(|goal| (goal.id, goal.accepted, goal.status.get()))
    }

    pub(crate) fn accepted(&self, id: GoalId) -> Stamp {
        self.list.iter().find(|goal| goal.id == id).map_or((0, 0), |goal| goal.accepted)
    }

    fn get(&mut self, id: GoalId) -> Option<&mut Goal<W>> {
        self.list.iter_mut().find(|goal| goal.id == id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cancel_code::{GOAL_TERMINATED, NONE, UNKNOWN_GOAL_ID};

    const A: GoalId = [1; 16];
    const B: GoalId = [2; 16];
    const C: GoalId = [3; 16];

    fn goals() -> Goals<u32> {
        let mut goals = Goals::new(Duration::from_nanos(100));
        for (id, sec) in [(A, 1), (B, 2), (C, 3)] {
            goals.accept(id, (sec, 0)).unwrap();
            goals.apply(id, GoalEvent::Execute).unwrap();
        }
        goals
    }

    #[test]
    fn who_is_cancelled() {
        let mut goals = goals();
        assert_eq!(goals.to_cancel(ANY, (0, 0)), (vec![A, B, C], NONE));
        assert_eq!(goals.to_cancel(B, (0, 0)), (vec![B], NONE));
        assert_eq!(goals.to_cancel(ANY, (2, 0)), (vec![A, B], NONE));
        assert_eq!(goals.to_cancel(C, (1, 5)), (vec![A, C], NONE));
        assert_eq!(goals.to_cancel([9; 16], (0, 0)), (vec![], UNKNOWN_GOAL_ID));
        goals.apply(B, GoalEvent::Succeed).unwrap();
        assert_eq!(goals.to_cancel(B, (0, 0)), (vec![], GOAL_TERMINATED));
        assert_eq!(goals.to_cancel(ANY, (0, 0)), (vec![A, C], NONE));
        goals.apply(A, GoalEvent::CancelGoal).unwrap();
        assert_eq!(
            goals.to_cancel(ANY, (0, 0)),
            (vec![C], NONE),
            "one that is being cancelled is not cancelled again"
        );
    }

    #[test]
    fn those_who_wait_for_a_result_are_not_more_than_can_be() {
        let mut goals = goals();
        let max = MAX_WAITING as u32;
        for who in 0..max {
            assert!(matches!(goals.request_result(A, who, |_| unreachable!()), ResultOf::Later));
        }
        assert!(matches!(goals.request_result(A, max, |_| true), ResultOf::TooMany(who) if who == max));
        assert!(
            matches!(goals.request_result(A, max, |who| who % 2 == 0), ResultOf::Later),
            "others have gone"
        );
        assert!(
            matches!(goals.request_result(B, 0, |_| unreachable!()), ResultOf::Later),
            "each goal has its own"
        );
        goals.apply(A, GoalEvent::Succeed).unwrap();
        assert_eq!(goals.finish(A, vec![], 0).len(), MAX_WAITING / 2 + 1);
    }

    #[test]
    fn results_are_given_to_those_who_wait_and_to_those_who_come_later_until_they_expire() {
        let mut goals = goals();
        assert_eq!(goals.accept(A, (9, 9)).err(), Some(GoalStatus::Executing), "one goal of an id");
        assert!(matches!(goals.request_result(A, 1, |_| true), ResultOf::Later));
        assert_eq!(goals.apply(A, GoalEvent::Canceled), Err(GoalStatus::Executing));
        goals.apply(A, GoalEvent::Succeed).unwrap();
        assert_eq!(goals.finish(A, vec![7], 1000), [1]);
        assert!(matches!(goals.request_result(A, 2, |_| true), ResultOf::Known(2, body) if body == [7]));
        assert!(!goals.expire(1099));
        assert!(goals.expire(1100));
        assert!(matches!(goals.request_result(A, 3, |_| true), ResultOf::Unknown(3)));
        assert_eq!((goals.status(A), goals.status(B)), (GoalStatus::Unknown, GoalStatus::Executing));
        assert!(!goals.expire(u64::MAX), "what is pursued does not expire");
        assert_eq!(goals.all().count(), 2);
    }
}
