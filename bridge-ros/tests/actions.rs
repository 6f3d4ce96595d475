// SPDX-License-Identifier: MIT OR Apache-2.0
//! Actions both ways, with rclpy on the other side: feedback, result, cancelling, rejecting.

mod support;

use futures::future::{Either, select};
use futures::{FutureExt, StreamExt};
use serde_json::json;
use std::pin::pin;
use std::time::Duration;
use support::node::{Spinning, fibonacci};
use support::{BridgeProcess, Peer, joined_nodes, ros};
use tautline::test_msgs::action::Fibonacci;
use tautline::{
    ActionServerGoal, ActionServerGoalRequest, CallbackHandle, CallbackOptions, Error, GoalStatus, Node,
    Timer,
};

/// `action_msgs/msg/GoalStatus`.
const SUCCEEDED: i8 = 4;
const CANCELED: i8 = 5;

/// As the one in `ros_services_peer.py`.
fn serve(node: &mut Node, name: &str) -> CallbackHandle {
    let mut goals = node.create_action_server::<Fibonacci::Action>(name).unwrap();
    let mut timer = node.create_wall_timer(Duration::from_millis(20)).unwrap();
    let serve = async move {
        while let Some(request) = goals.next().await {
            let request: ActionServerGoalRequest<Fibonacci::Action> = request;
            if request.goal.order < 0 {
                request.reject().unwrap();
                continue;
            }
            let (mut goal, mut cancels) = request.accept().unwrap();
            let pursued = goal.clone();
            let pursuit = pin!(pursue(&pursued, &mut timer));
            match select(pursuit, cancels.next()).await {
                Either::Left((sequence, _)) => goal.succeed(Fibonacci::Result { sequence }).unwrap(),
                Either::Right((cancel, _)) => {
                    cancel.expect("the goal goes on").accept();
                    goal.cancel(Fibonacci::Result { sequence: vec![-1] }).unwrap();
                }
            }
        }
    };
    node.spawn_callback(CallbackOptions::other(), serve).unwrap()
}

async fn pursue(goal: &ActionServerGoal<Fibonacci::Action>, timer: &mut Timer) -> Vec<i32> {
    let order = usize::try_from(goal.goal.order).unwrap();
    for len in 2..=order {
        goal.publish_feedback(Fibonacci::Feedback { sequence: fibonacci(len - 1) }).unwrap();
        timer.tick().await.unwrap();
    }
    fibonacci(order)
}

#[test]
fn ros_has_goals_pursued_here() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 20;
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN, &[]);
    let mut here = Spinning::new(DOMAIN, "here");
    let _served = serve(&mut here.node, "/fibonacci");
    let mut peer = Peer::start_with_services(&venv, DOMAIN, "there");
    let client = peer.tell(json!({ "do": "action_client", "name": "/fibonacci" }));
    for order in [6, 10] {
        // The first of it too, which is published before the bridge has seen that somebody in ROS listens.
        let expected: Vec<_> = (2..=order).map(|len| fibonacci(len - 1)).collect();
        let goal = json!({ "do": "goal", "end": client, "order": order, "told": expected.len() });
        let outcome = peer.tell(goal);
        assert_eq!((&outcome["status"], &outcome["sequence"]), (&json!(SUCCEEDED), &json!(fibonacci(order))));
        assert_eq!(outcome["feedback"], json!(expected));
    }
    let outcome = peer.tell(json!({ "do": "goal", "end": client, "order": 5000, "cancel_after": 3 }));
    assert_eq!((&outcome["status"], &outcome["cancelling"]), (&json!(CANCELED), &json!(1)));
    assert_eq!(outcome["sequence"], json!([-1]));
    let outcome = peer.tell(json!({ "do": "goal", "end": client, "order": -1 }));
    assert_eq!(outcome, json!({ "accepted": false }));
    let goals = bridge.wait_for("numbers", |stats| {
        let services = stats["services"].as_array().cloned().unwrap_or_default();
        services.iter().any(|end| end["service"] == "/fibonacci/_action/send_goal" && end["answered"] == 4)
    });
    assert!(goals["services"].as_array().unwrap().iter().all(|end| end["failed"] == json!({})), "{goals}");
}

#[test]
fn goals_from_here_are_pursued_in_ros() {
    let Some((_bridge, mut here, mut peer)) = joined_nodes(21) else { return };
    peer.tell(json!({ "do": "action_server", "name": "/fibonacci" }));
    let client = here.node.create_action_client::<Fibonacci::Action>("/fibonacci").unwrap();
    let available = client.wait_for_action_server().unwrap();
    here.wait("the action", available).unwrap();

    let sent = client.send_goal_request(Fibonacci::Goal { order: 8 }).unwrap();
    let (goal, result, feedback) = here.wait("a goal", sent).unwrap();
    let both = futures::future::join(result, feedback.map(|feedback| feedback.sequence).collect::<Vec<_>>());
    let (result, told) = here.wait("a result", both);
    let (status, result) = result.unwrap();
    assert_eq!((status, result.sequence), (GoalStatus::Succeeded, fibonacci(8)));
    let expected: Vec<_> = (2..=8).map(|len| fibonacci(len - 1)).collect();
    assert_eq!(told, expected);
    assert_eq!(goal.status(), GoalStatus::Succeeded);

    let sent = client.send_goal_request(Fibonacci::Goal { order: 5000 }).unwrap();
    let (goal, result, mut feedback) = here.wait("a goal", sent).unwrap();
    here.wait("feedback", feedback.next().map(Option::unwrap));
    let cancelled = goal.cancel().unwrap();
    here.wait("cancelling", cancelled).unwrap();
    let (status, result) = here.wait("a result", result).unwrap();
    assert_eq!((status, result.sequence), (GoalStatus::Canceled, vec![-1]));

    let sent = client.send_goal_request(Fibonacci::Goal { order: -1 }).unwrap();
    let rejected = here.wait("an answer", sent).err();
    assert!(matches!(rejected, Some(Error::GoalRejected { .. })), "{rejected:?}");
}
