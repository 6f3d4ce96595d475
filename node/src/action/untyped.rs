// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clients of actions whose type is known by name: goals, results and feedback as JSON.

use super::client::{ActionClientState, Feedback, Held, Protocol, ResultFuture};
use super::state::GoalStatus;
use super::{Names, feedback_qos, qos};
use crate::error::{Error, Result};
use crate::node::Node;
use crate::service::{ClientUntyped, IsAvailablePollable};
use futures::future::BoxFuture;
use futures::{FutureExt, Stream, StreamExt, future};
use serde_json::{Value, json};
use std::future::Future;
use std::sync::Arc;
use tautline_msgs::GoalId;
use tautline_transport::Availability;
use uuid::Uuid;

impl Node {
    /// Creates a client of an action of a type that is known by name, `example_interfaces/action/Fibonacci`: goals, results and
    /// feedback are JSON.
    ///
    /// # Errors
    /// As [`create_client_untyped`](Self::create_client_untyped) and [`create_action_client`](Self::create_action_client).
    pub fn create_action_client_untyped(
        &mut self,
        action_name: &str,
        action_type: &str,
    ) -> Result<ActionClientUntyped> {
        let action = self.resolve_topic_name(action_name)?;
        let names = Names::of(&action);
        let part = |part: &str| format!("{action_type}_{part}");
        let send_goal = self.create_client_untyped(&names.send_goal, &part("SendGoal"), qos())?;
        let get_result = self.create_client_untyped(&names.get_result, &part("GetResult"), qos())?;
        let feedback_type = part("FeedbackMessage");
        let messages = self.subscribe_untyped(&names.feedback, &feedback_type, feedback_qos())?;
        let counters = messages.counters();
        let messages = messages.filter_map(|message| future::ready(message.ok().and_then(take_apart)));
        let feedback = Feedback { messages: messages.boxed(), counters };
        let shared = ActionClientState::create(self, &action, Json { send_goal, get_result }, feedback)?;
        Ok(ActionClientUntyped { shared })
    }
}

/// Whose feedback it is. `None` if it is nobody's.
fn take_apart(mut message: Value) -> Option<(GoalId, Result<Value>)> {
    let bytes = message["goal_id"]["uuid"].as_array()?.iter().map(|byte| Some(byte.as_u64()? as u8));
    let id = GoalId::try_from(bytes.collect::<Option<Vec<_>>>()?).ok()?;
    Some((id, Ok(message["feedback"].take())))
}

struct Json {
    send_goal: ClientUntyped,
    get_result: ClientUntyped,
}

impl Protocol for Json {
    type Goal = Value;
    /// As in r2r.
    type Result = Result<Value>;
    type Feedback = Result<Value>;

    fn send_goal(&self, id: GoalId, goal: Value) -> Result<BoxFuture<'static, Result<bool>>> {
        let response = self.send_goal.request(json!({ "goal_id": { "uuid": id }, "goal": goal }))?;
        Ok(response.map(|response| Ok(response??["accepted"] == true)).boxed())
    }

    fn get_result(&self, id: GoalId) -> Result<ResultFuture<Self>> {
        let response = self.get_result.request(json!({ "goal_id": { "uuid": id } }))?;
        let take_apart = |response: Result<Value>| match response {
            Ok(mut response) => {
                let status = response["status"].as_i64().and_then(|status| i8::try_from(status).ok());
                let status = GoalStatus::from_rcl(status.unwrap_or_default());
                (status, Ok(response["result"].take()))
            }
            Err(error) => (GoalStatus::Unknown, Err(error)),
        };
        Ok(response.map(move |response| response.map(take_apart)).boxed())
    }

    fn availability(&self) -> Result<Vec<Availability>> {
        let mut both = self.send_goal.availability()?;
        both.extend(self.get_result.availability()?);
        Ok(both)
    }
}

/// Sends goals as JSON to an action's server. A clone is the same client.
#[derive(Clone)]
pub struct ActionClientUntyped {
    shared: Arc<ActionClientState<Json>>,
}

impl ActionClientUntyped {
    /// As [`ActionClient::send_goal_request`](crate::ActionClient::send_goal_request). Results and feedback are errors if they
    /// are not of the type.
    ///
    /// # Errors
    /// [`Error::Message`] if it is not a goal of the type; as
    /// [`ActionClient::send_goal_request`](crate::ActionClient::send_goal_request).
    #[allow(clippy::type_complexity, reason = "a future of a goal, its result and its feedback")]
    pub fn send_goal_request(
        &self,
        goal: Value,
    ) -> Result<
        impl Future<
            Output = Result<(
                ActionClientGoalUntyped,
                impl Future<Output = Result<(GoalStatus, Result<Value>)>> + Unpin + Send + use<>,
                impl Stream<Item = Result<Value>> + Unpin + Send + use<>,
            )>,
        > + Send
        + use<>,
    > {
        let sent = self.shared.send(goal)?;
        Ok(async move {
            let (held, result, feedback) = sent.await?;
            Ok::<_, Error>((
                ActionClientGoalUntyped { uuid: Uuid::from_bytes(held.id), held },
                result,
                feedback,
            ))
        })
    }
}

/// A goal that was accepted. A clone is the same goal.
#[derive(Clone)]
pub struct ActionClientGoalUntyped {
    /// The goal's id.
    pub uuid: Uuid,
    held: Held<Json>,
}

impl ActionClientGoalUntyped {
    /// What was last heard of the goal.
    pub fn status(&self) -> GoalStatus {
        self.held.status.get()
    }

    /// As [`ActionClientGoal::cancel`](crate::ActionClientGoal::cancel).
    ///
    /// # Errors
    /// As [`ActionClientGoal::cancel`](crate::ActionClientGoal::cancel).
    pub fn cancel(&self) -> Result<impl Future<Output = Result<()>> + Unpin + Send + use<>> {
        self.held.shared.cancel(self.held.id)
    }
}

impl IsAvailablePollable for ActionClientUntyped {
    fn availability(&self) -> Result<Vec<Availability>> {
        self.shared.availability()
    }
}

impl std::fmt::Debug for ActionClientUntyped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ActionClientUntyped").finish_non_exhaustive()
    }
}

impl std::fmt::Debug for ActionClientGoalUntyped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ActionClientGoalUntyped").field("uuid", &self.uuid).finish_non_exhaustive()
    }
}
