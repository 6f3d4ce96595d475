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
/// `example_interfaces::action::Fibonacci::Action`.
pub trait Action: Send + Sync + 'static {
    /// What a client asks for.
    type Goal: Message;
    /// What it gets at the end.
    type Result: Message;
    /// What it hears on the way.
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
}
