// SPDX-License-Identifier: MIT OR Apache-2.0
//! Actions: goals that are executed with feedback until there is a result, and that can be cancelled. An action consists of
//! services and topics with ROS 2's names: `<action>/_action/send_goal`, `cancel_goal`, `get_result`, `feedback`, `status`.

mod client;
mod goals;
mod names;
mod server;
#[cfg(feature = "untyped")]
mod untyped;

pub use client::{ActionClient, ActionClientGoal, ActionCodec};
pub use server::{ActionServerCancelRequest, ActionServerGoal, ActionServerGoalRequest, ActionServerOptions};

#[allow(unused_imports, reason = "for the documentation")]
use crate::error::Error;
use crate::error::Result;
use crate::node::Node;
use futures::Stream;
use names::{Names, feedback_qos};
use tautline_msgs::Action;

/// Each action server and each action client has a callback of its own, on a thread of ordinary priority named after the
/// action, which responds to requests and receives messages while goals are executed elsewhere.
impl Node {
    /// Creates an action server: a stream of goals, each to be accepted or rejected. A goal that is dropped is rejected; an
    /// accepted goal that is dropped without a result is aborted. Up to 1000 goals are queued in the stream; further goals are
    /// rejected. The server ends when the stream and the last goal are dropped.
    ///
    /// ```
    /// # #[cfg(feature = "example_interfaces")] {
    /// use futures::StreamExt;
    /// use tautline::example_interfaces::action::Fibonacci;
    /// # use tautline::{CallbackOptions, Context, Node, Realtime};
    /// # let ctx = Context::builder().domain(129).realtime(Realtime::Off).build()?;
    /// # let mut node = Node::create(ctx.clone(), "example", "")?;
    /// let mut goals = node.create_action_server::<Fibonacci::Action>("/fibonacci")?;
    /// node.spawn_callback(CallbackOptions::other(), async move {
    ///     while let Some(request) = goals.next().await {
    ///         let (mut goal, _cancel_requests) = request.accept().expect("it was not accepted before");
    ///         let mut sequence = vec![0, 1];
    ///         for n in 1..goal.goal.order as usize {
    ///             sequence.push(sequence[n] + sequence[n - 1]);
    ///             goal.publish_feedback(Fibonacci::Feedback { sequence: sequence.clone() }).unwrap();
    ///         }
    ///         goal.succeed(Fibonacci::Result { sequence }).unwrap();
    ///     }
    /// })?;
    /// let client = node.create_action_client::<Fibonacci::Action>("/fibonacci")?;
    /// let available = client.wait_for_action_server()?;
    /// let stop = ctx.events().clone();
    /// node.spawn_callback(CallbackOptions::other(), async move {
    ///     available.await.unwrap();
    ///     let goal = client.send_goal_request(Fibonacci::Goal { order: 4 }).unwrap();
    ///     let (_goal, result, feedback) = goal.await.expect("it is accepted");
    ///     assert_eq!(feedback.count().await, 3); // ends with the goal
    ///     assert_eq!(result.await.unwrap().1.sequence, [0, 1, 1, 2, 3]);
    ///     stop.stop();
    /// })?;
    /// ctx.spin()?;
    /// # }
    /// # Ok::<(), tautline::Error>(())
    /// ```
    ///
    /// # Errors
    /// As [`create_service`](Self::create_service); as [`spawn_callback`](Self::spawn_callback).
    pub fn create_action_server<T: Action>(
        &mut self,
        action_name: &str,
    ) -> Result<impl Stream<Item = ActionServerGoalRequest<T>> + Unpin + Send + use<T>> {
        self.create_action_server_with(action_name, ActionServerOptions::default())
    }

    /// [`create_action_server`](Self::create_action_server) with settings.
    ///
    /// # Errors
    /// As [`create_action_server`](Self::create_action_server).
    pub fn create_action_server_with<T: Action>(
        &mut self,
        action_name: &str,
        options: ActionServerOptions,
    ) -> Result<impl Stream<Item = ActionServerGoalRequest<T>> + Unpin + Send + use<T>> {
        let name = self.resolve_topic_name(action_name)?;
        server::create(self, &name, options)
    }

    /// Creates an action client.
    ///
    /// # Errors
    /// As [`create_client`](Self::create_client); as [`spawn_callback`](Self::spawn_callback).
    pub fn create_action_client<T: Action>(&mut self, action_name: &str) -> Result<ActionClient<T>> {
        let action = self.resolve_topic_name(action_name)?;
        let names = Names::of(&action);
        let send_goal = self.create_client(&names.send_goal)?;
        let get_result = self.create_client(&names.get_result)?;
        let feedback = self.subscribe(&names.feedback, feedback_qos())?;
        ActionClient::create(self, &action, send_goal, get_result, feedback)
    }
}
