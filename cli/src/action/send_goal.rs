// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut action send_goal`: sends a goal, prints its feedback and result, and cancels it on an interruption.

use crate::arguments::{WrittenMessage, full_name, type_and_values};
use crate::call::{Caller, poll_future};
use crate::completions;
use crate::service::{actions, type_to_call};
use crate::verb::{CommonArgs, End, Failure, Outcome, Waited};
use clap::Args;
use futures::channel::oneshot;
use futures::future::{Either, select};
use futures::{FutureExt, StreamExt};
use serde_json::{Value, json};
use std::io::Write;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;
use tautline::{ActionClient, Error, GoalStatus, Json};
use tautline_definitions::find_schema;
use tautline_schema::{DynamicMessage, Schema};
use tautline_transport::{GraphSnapshot, TopicType, graph_of};

/// How long an action's server may take to cancel a goal.
const CANCELLING: Duration = Duration::from_secs(10);

/// Sends a goal, and prints its result
///
/// Values are YAML or JSON; omitted fields have their defaults. Ctrl-C, or the end of --timeout, cancels the goal and waits for the
/// server's response; a second Ctrl-C does not wait.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut action send_goal /fibonacci '{order: 5}' --feedback
  taut action send_goal /fibonacci example_interfaces/action/Fibonacci '{order: 5}' --timeout 10s
  taut action send_goal /fibonacci '{order: 5}' --feedback --json | jq .feedback.sequence

Exit codes: 0 the goal has succeeded, 1 it was rejected, aborted or cancelled, 2 it is no goal of the action's type.")]
pub struct SendGoalArgs {
    /// The action
    #[arg(value_name = "ACTION", add = completions::action_servers())]
    action: String,
    /// The type, if there are servers of several, and the values, if they are not the defaults
    #[arg(value_name = "[TYPE] [VALUES]", num_args = 0..=2, add = completions::action_types())]
    goal: Vec<String>,
    /// Print the feedback
    #[arg(short, long)]
    feedback: bool,
}

pub fn run(args: &SendGoalArgs, common: &CommonArgs) -> Outcome {
    let (end, domain, action) = (End::of(common)?, common.domain()?, full_name(&args.action));
    let (type_name, values) = type_and_values(&args.goal, "action");
    let graph = graph_of(domain)?;
    let type_name = type_to_call("action", &action, &actions(&graph), type_name)?;
    let parts = Parts(&graph, &action, &type_name);
    let goal = parts.of("Goal", "SendGoal", parts.service("send_goal"))?;
    let goal = WrittenMessage::new(&goal, values)?.message;
    let mut caller = Caller::new(domain, end)?;
    let client = caller.node.create_action_client_untyped(&action, &type_name)?;
    let of_feedback = graph.topic_type(&format!("{action}/_action/feedback"));
    let shown = Shown {
        feedback: parts.of("Feedback", "FeedbackMessage", of_feedback)?,
        result: parts.of("Result", "GetResult", parts.service("get_result"))?,
        is_json: common.json,
    };
    let (cancel, cancelled) = oneshot::channel();
    let pursuit = pursue(&client, goal.to_json_value(), args.feedback, cancelled, &shown);
    let status = wait(&mut caller.end, &action, pursuit, cancel)?;
    match status {
        GoalStatus::Succeeded => Ok(()),
        status => Err(Failure::no(format!("the goal was not reached: it is {status}"))),
    }
}

/// Waits until the goal has ended. The first interruption, or the end of the time, cancels the goal.
fn wait(
    end: &mut End,
    action: &str,
    pursuit: impl Future<Output = Outcome<GoalStatus>>,
    cancel: oneshot::Sender<()>,
) -> Outcome<GoalStatus> {
    let (mut pursuit, mut cancel) = (poll_future(pursuit), Some(cancel));
    loop {
        let what = || match cancel {
            Some(_) => format!("'{action}' to reach the goal"),
            None => format!("'{action}' to cancel the goal"),
        };
        let why = match end.try_wait(what, &mut pursuit)? {
            Waited::Ready(status) => return status,
            Waited::TimedOut => "not reached in time",
            Waited::Interrupted => "interrupted",
        };
        let Some(cancel) = cancel.take() else {
            return Err(Failure::no("did not wait for the end of the goal, which may still run"));
        };
        eprintln!("taut: {why}: cancelling the goal");
        end.again(CANCELLING);
        // A failure to cancel is ignored, because the goal has ended.
        let _ = cancel.send(());
    }
}

async fn pursue(
    client: &ActionClient<Json>,
    goal: Value,
    with_feedback: bool,
    cancelled: oneshot::Receiver<()>,
    shown: &Shown,
) -> Outcome<GoalStatus> {
    let no = |error: Error| Failure::no(error.to_string());
    let mut cancelled = cancelled.fuse();
    // Before there is a goal there is nothing to cancel.
    match select(client.wait_for_action_server()?, &mut cancelled).await {
        Either::Left((available, _)) => available.map_err(no)?,
        Either::Right(_) => return Err(Failure::no("there is no server yet: nothing was sent")),
    }
    let (goal, result, feedback) = match client.send_goal_request(goal)?.await {
        Err(error @ Error::GoalRejected { .. }) => {
            shown.line(&json!({ "accepted": false }), || Ok("Goal was rejected.\n".into()))?;
            return Err(no(error));
        }
        sent => sent.map_err(no)?,
    };
    let id = goal.uuid.to_string();
    shown
        .line(&json!({ "accepted": true, "goal_id": id }), || Ok(format!("Goal accepted with ID: {id}\n")))?;
    let mut feedback =
        if with_feedback { feedback.left_stream() } else { futures::stream::empty().right_stream() };
    let ended = async {
        // Ends with the goal.
        while let Some(message) = feedback.next().await {
            let message = message?;
            shown.line(&json!({ "feedback": message }), || {
                Ok(format!("Feedback:\n{}", yaml(&shown.feedback, &message)?))
            })?;
        }
        let (status, result) = result.await.map_err(no)?;
        let result = result?;
        let name = status.to_string().to_uppercase();
        shown.line(&json!({ "status": name, "result": result }), || {
            Ok(format!("Result:\n{}Goal finished with status: {name}\n", yaml(&shown.result, &result)?))
        })?;
        Ok(status)
    };
    let refused = async {
        if cancelled.await.is_err() {
            return std::future::pending().await;
        }
        match goal.cancel() {
            Ok(answer) => match answer.await {
                // The result contains the outcome.
                Ok(()) | Err(Error::GoalCancelAlreadyTerminated) => std::future::pending().await,
                Err(error) => error,
            },
            Err(error) => error,
        }
    };
    match select(pin!(ended), pin!(refused)).await {
        Either::Left((ended, _)) => ended,
        Either::Right((error, _)) => Err(Failure::no(format!("the goal continues: {error}"))),
    }
}

/// How feedback and results are printed.
struct Shown {
    feedback: Arc<Schema>,
    result: Arc<Schema>,
    is_json: bool,
}

impl Shown {
    fn line(&self, json: &Value, text: impl FnOnce() -> Outcome<String>) -> Outcome {
        let mut out = crate::print::stdout();
        match self.is_json {
            true => writeln!(out, "{json}")?,
            false => write!(out, "{}", text()?)?,
        }
        Ok(out.flush()?)
    }
}

fn yaml(schema: &Arc<Schema>, message: &Value) -> Outcome<String> {
    let text = DynamicMessage::from_json_value(schema, message)?.to_string();
    Ok(text.lines().map(|line| format!("    {line}\n")).collect())
}

/// The definitions of an action's goals, feedback and results. They are parts of the definitions of its services and topic.
struct Parts<'a>(&'a GraphSnapshot, &'a str, &'a str);

impl Parts<'_> {
    fn service(&self, part: &str) -> Option<TopicType> {
        let Parts(graph, action, _) = self;
        let name = format!("{action}/_action/{part}");
        let end = graph.services.iter().find(|end| end.name == name && end.type_hash.is_some())?;
        Some(TopicType::new(end.type_name.clone()).with_hash(end.type_hash.clone()?))
    }

    fn of(&self, part: &str, whole: &str, existing: Option<TopicType>) -> Outcome<Arc<Schema>> {
        let Parts(_, action, type_name) = self;
        let schema = find_schema(action, &format!("{type_name}_{whole}").parse()?, existing.as_ref())?;
        Ok(schema.of_part(&format!("{type_name}_{part}").parse()?)?.into())
    }
}
