// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::Message;

/// A service: a request, answered by a response. Generated code implements it for a unit struct,
/// `std_srvs::srv::SetBool::Service`.
pub trait Service: Send + Sync + 'static {
    /// What a client sends.
    type Request: Message;
    /// What the server answers.
    type Response: Message;
    /// What introspection publishes of both.
    type Event: Message;
    /// The ROS 2 name, `package/srv/Name`.
    const TYPE_NAME: &'static str;
    /// The RIHS01 hash of the definition.
    const TYPE_HASH: &'static str;
}

/// An action: a goal, pursued with feedback until there is a result. Generated code implements it for a unit struct,
/// `example_interfaces::action::Fibonacci::Action`. Its functions build the messages that are sent, and split
/// received ones.
pub trait Action: Send + Sync + 'static {
    /// The goal that a client sends.
    type Goal: Message;
    /// The result that the client gets at the end.
    type Result: Message + Default;
    /// The feedback that the client gets meanwhile.
    type Feedback: Message;
    /// The feedback with the goal's id, as published.
    type FeedbackMessage: Message;
    /// The service that sends a goal.
    type SendGoal: Service;
    /// The service that waits for the result.
    type GetResult: Service;
    /// The ROS 2 name, `package/action/Name`.
    const TYPE_NAME: &'static str;
    /// The RIHS01 hash of the definition.
    const TYPE_HASH: &'static str;

    /// The request that sends a goal.
    fn make_goal_request_msg(goal_id: GoalId, goal: Self::Goal) -> <Self::SendGoal as Service>::Request;
    /// The response to a goal, with the time of acceptance in seconds and nanoseconds.
    fn make_goal_response_msg(accepted: bool, stamp: (i32, u32)) -> <Self::SendGoal as Service>::Response;
    /// The feedback with its goal's id.
    fn make_feedback_msg(goal_id: GoalId, feedback: Self::Feedback) -> Self::FeedbackMessage;
    /// The request that waits for a result.
    fn make_result_request_msg(goal_id: GoalId) -> <Self::GetResult as Service>::Request;
    /// The response to a request for a result.
    fn make_result_response_msg(status: i8, result: Self::Result) -> <Self::GetResult as Service>::Response;
    /// The id and the goal.
    fn destructure_goal_request_msg(msg: <Self::SendGoal as Service>::Request) -> (GoalId, Self::Goal);
    /// Whether the goal was accepted, and when.
    fn destructure_goal_response_msg(msg: <Self::SendGoal as Service>::Response) -> (bool, (i32, u32));
    /// The goal's id and the feedback.
    fn destructure_feedback_msg(msg: Self::FeedbackMessage) -> (GoalId, Self::Feedback);
    /// The status and the result.
    fn destructure_result_response_msg(msg: <Self::GetResult as Service>::Response) -> (i8, Self::Result);
    /// The goal's id.
    fn destructure_result_request_msg(msg: <Self::GetResult as Service>::Request) -> GoalId;
}

/// The bytes of a goal's UUID.
pub type GoalId = [u8; 16];
