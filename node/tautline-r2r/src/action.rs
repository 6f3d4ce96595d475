// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::client::{IsAvailablePollable, sealed::Wait};
use futures::Stream;
use futures::future::BoxFuture;
use tautline::codec::ActionCodec;
use tautline::{Action, ActionServerCancelRequest, GoalStatus, Json, Result};

/// An action client with r2r's API; it wraps a [`tautline::ActionClient`]. A clone is the same client.
#[derive(Debug)]
pub struct ActionClient<T: ActionCodec>(tautline::ActionClient<T>);

impl<T: ActionCodec> ActionClient<T> {
    /// As [`tautline::ActionClient::send_goal_request`].
    #[allow(clippy::type_complexity, reason = "it is r2r's")]
    pub fn send_goal_request(
        &self,
        goal: T::Goal,
    ) -> Result<
        impl Future<
            Output = Result<(
                ActionClientGoal<T>,
                impl Future<Output = Result<(GoalStatus, T::Result)>> + Unpin + Send + use<T>,
                impl Stream<Item = T::Feedback> + Unpin + Send + use<T>,
            )>,
        > + Send
        + use<T>,
    > {
        let sent = self.0.send_goal_request(goal)?;
        Ok(async move {
            let (goal, result, feedback) = sent.await?;
            Ok((goal.into(), result, feedback))
        })
    }
}

/// A goal with r2r's API; it wraps a [`tautline::ActionClientGoal`]. A clone is the same goal.
#[derive(Debug)]
pub struct ActionClientGoal<T: ActionCodec>(tautline::ActionClientGoal<T>);

impl<T: ActionCodec> ActionClientGoal<T> {
    /// The last known status of the goal.
    ///
    /// # Errors
    /// None.
    pub fn get_status(&self) -> Result<GoalStatus> {
        Ok(self.0.status())
    }
}

/// An action client of a type that is known by name.
pub type ActionClientUntyped = ActionClient<Json>;
/// A goal of a type that is known by name.
pub type ActionClientGoalUntyped = ActionClientGoal<Json>;

/// A goal that a client sent, to be accepted or rejected, with r2r's API; it wraps a [`tautline::ActionServerGoalRequest`]. Dropping it
/// rejects the goal.
#[derive(Debug)]
pub struct ActionServerGoalRequest<T: Action>(tautline::ActionServerGoalRequest<T>);

impl<T: Action> ActionServerGoalRequest<T> {
    /// As [`tautline::ActionServerGoalRequest::accept`].
    pub fn accept(
        self,
    ) -> Result<(ActionServerGoal<T>, impl Stream<Item = ActionServerCancelRequest> + Unpin + Send + use<T>)>
    {
        let (goal, cancels) = self.0.accept()?;
        Ok((goal.into(), cancels))
    }

    /// As [`tautline::ActionServerGoalRequest::reject`].
    pub fn reject(self) -> Result<()> {
        self.0.reject()
    }
}

/// A goal that was accepted, with r2r's API; it wraps a [`tautline::ActionServerGoal`].
#[derive(Debug)]
pub struct ActionServerGoal<T: Action>(tautline::ActionServerGoal<T>);

impl<T: Action> ActionServerGoal<T> {
    /// Whether a request to cancel this goal was accepted.
    ///
    /// # Errors
    /// None.
    pub fn is_cancelling(&self) -> Result<bool> {
        Ok(self.0.is_cancelling())
    }
}

impl<T: ActionCodec> Clone for ActionClient<T> {
    fn clone(&self) -> Self {
        ActionClient(self.0.clone())
    }
}

impl<T: ActionCodec> Clone for ActionClientGoal<T> {
    fn clone(&self) -> Self {
        ActionClientGoal(self.0.clone())
    }
}

impl<T: Action> Clone for ActionServerGoal<T>
where
    T::Goal: Clone,
{
    fn clone(&self) -> Self {
        ActionServerGoal(self.0.clone())
    }
}

impl<T: ActionCodec> IsAvailablePollable for ActionClient<T> {}

impl<T: ActionCodec> Wait for ActionClient<T> {
    fn wait(&self) -> Result<BoxFuture<'static, Result<()>>> {
        Ok(Box::pin(self.0.wait_for_action_server()?))
    }
}

beneath!(ActionClient<T: ActionCodec>);
beneath!(ActionClientGoal<T: ActionCodec>);
beneath!(ActionServerGoalRequest<T: Action>);
beneath!(ActionServerGoal<T: Action>);
