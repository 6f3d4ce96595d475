// SPDX-License-Identifier: MIT OR Apache-2.0
//! Actions whose type is known by name: goals, results and feedback as JSON.

use super::client::{ActionClient, ActionCodec};
use super::names::{Names, feedback_qos};
use crate::error::Result;
use crate::goal_state::GoalStatus;
use crate::node::Node;
use crate::untyped::Json;
use serde_json::{Value, json};
use tautline_msgs::GoalId;

impl Node {
    /// Creates a client of an action of a type that is known by name, `example_interfaces/action/Fibonacci`: goals, results and
    /// feedback are JSON. A result that is not valid for the type is an error; such feedback is skipped.
    ///
    /// # Errors
    /// As [`create_client_untyped`](Self::create_client_untyped) and [`create_action_client`](Self::create_action_client).
    pub fn create_action_client_untyped(
        &mut self,
        action_name: &str,
        action_type: &str,
    ) -> Result<ActionClient<Json>> {
        let action = self.resolve_topic_name(action_name)?;
        let names = Names::of(&action);
        let part = |part: &str| format!("{action_type}_{part}");
        let send_goal = self.create_client_untyped(&names.send_goal, &part("SendGoal"))?;
        let get_result = self.create_client_untyped(&names.get_result, &part("GetResult"))?;
        let feedback = self.subscribe_untyped(&names.feedback, &part("FeedbackMessage"), feedback_qos())?;
        ActionClient::create(self, &action, send_goal, get_result, feedback)
    }
}

impl ActionCodec for Json {
    type Goal = Value;
    /// As in r2r.
    type Result = Result<Value>;
    type Feedback = Result<Value>;
    type FeedbackMessage = Json;
    type SendGoal = Json;
    type GetResult = Json;

    fn goal_request(id: GoalId, goal: Value) -> Json {
        Json(json!({ "goal_id": { "uuid": id }, "goal": goal }))
    }

    fn is_accepted(response: Result<Value>) -> Result<bool> {
        Ok(response?["accepted"] == true)
    }

    fn result_request(id: GoalId) -> Json {
        Json(json!({ "goal_id": { "uuid": id } }))
    }

    fn take_result(response: Result<Value>) -> (GoalStatus, Result<Value>) {
        match response {
            Ok(mut response) => {
                let status = response["status"].as_i64().and_then(|status| i8::try_from(status).ok());
                let status = GoalStatus::from_rcl(status.unwrap_or_default());
                (status, Ok(response["result"].take()))
            }
            Err(error) => (GoalStatus::Unknown, Err(error)),
        }
    }

    fn take_feedback(message: Result<Value>) -> Option<(GoalId, Result<Value>)> {
        let mut message = message.ok()?;
        let bytes = message["goal_id"]["uuid"].as_array()?.iter().map(|byte| Some(byte.as_u64()? as u8));
        let id = GoalId::try_from(bytes.collect::<Option<Vec<_>>>()?).ok()?;
        Some((id, Ok(message["feedback"].take())))
    }
}
