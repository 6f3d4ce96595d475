// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs in the style of r2r 0.9.7's examples `action_server`, `action_client` and `action_client_untyped`: all of it in one
//! thread, which spins and runs a pool.

use crate::{Done, run};
use futures::executor::{LocalPool, LocalSpawner};
use futures::future::{self, Either};
use futures::stream::{Stream, StreamExt};
use futures::task::LocalSpawnExt;
use r2r::example_interfaces::action::Fibonacci;
use std::sync::{Arc, Mutex};
use tautline as r2r;

async fn run_goal(
    node: Arc<Mutex<r2r::Node>>,
    g: r2r::ActionServerGoal<Fibonacci::Action>,
) -> Fibonacci::Result {
    let mut timer = node
        .lock()
        .unwrap()
        .create_wall_timer(std::time::Duration::from_millis(1))
        .expect("could not create timer");
    let mut feedback_msg = Fibonacci::Feedback { sequence: vec![0, 1] };
    g.publish_feedback(feedback_msg.clone()).expect("fail");
    let order = g.goal.order as usize;
    for i in 1..order {
        feedback_msg.sequence.push(feedback_msg.sequence[i].wrapping_add(feedback_msg.sequence[i - 1]));
        g.publish_feedback(feedback_msg.clone()).expect("fail");
        timer.tick().await.unwrap();
    }
    Fibonacci::Result { sequence: feedback_msg.sequence }
}

async fn fibonacci_server(
    spawner: LocalSpawner,
    node: Arc<Mutex<r2r::Node>>,
    mut requests: impl Stream<Item = r2r::ActionServerGoalRequest<Fibonacci::Action>> + Unpin,
) {
    while let Some(req) = requests.next().await {
        let (mut g, mut cancel) = req.accept().expect("could not accept goal");
        let goal_fut = spawner.spawn_local_with_handle(run_goal(node.clone(), g.clone())).unwrap();
        match future::select(goal_fut, cancel.next()).await {
            Either::Left((result, _)) => g.succeed(result).expect("could not send result"),
            Either::Right((request, _)) => {
                if let Some(request) = request {
                    request.accept();
                }
            }
        };
    }
}

fn server(pool: &LocalPool, node: &Arc<Mutex<r2r::Node>>) {
    let requests = node.lock().unwrap().create_action_server::<Fibonacci::Action>("/fibonacci").unwrap();
    let spawner = pool.spawner();
    spawner.spawn_local(fibonacci_server(spawner.clone(), node.clone(), requests)).unwrap();
}

#[test]
fn client() {
    let ctx = crate::context(56, "");
    let node = Arc::new(Mutex::new(r2r::Node::create(ctx, "testnode", "").unwrap()));
    let mut pool = LocalPool::new();
    server(&pool, &node);
    let client = node.lock().unwrap().create_action_client::<Fibonacci::Action>("/fibonacci").unwrap();
    let action_server_available = r2r::Node::is_available(&client).unwrap();
    let done = Done::default();
    let (task_spawner, task_done) = (pool.spawner(), done.clone());
    pool.spawner()
        .spawn_local(async move {
            action_server_available.await.expect("could not await action server");
            let (goal, result, feedback) = client
                .send_goal_request(Fibonacci::Goal { order: 5 })
                .expect("could not send goal request")
                .await
                .expect("goal rejected by server");
            let nested_goal = goal.clone();
            task_spawner
                .spawn_local(feedback.for_each(move |_msg| {
                    let nested_goal = nested_goal.clone();
                    async move { assert!(nested_goal.get_status().is_ok()) }
                }))
                .unwrap();
            let (status, msg) = result.await.expect("action failed");
            assert_eq!(status, r2r::GoalStatus::Succeeded);
            task_done.set(msg.sequence.into_iter().map(i64::from).collect());
        })
        .unwrap();
    let mut spinning = node.lock().unwrap().context().clone();
    assert_eq!(run(&mut spinning, &mut pool, &done), [0, 1, 1, 2, 3, 5]);
}

#[cfg(feature = "untyped")]
#[test]
fn client_untyped_that_cancels() {
    let ctx = crate::context(55, "");
    let node = Arc::new(Mutex::new(r2r::Node::create(ctx, "testnode", "").unwrap()));
    let mut pool = LocalPool::new();
    server(&pool, &node);
    let client = node
        .lock()
        .unwrap()
        .create_action_client_untyped("/fibonacci", "example_interfaces/action/Fibonacci")
        .unwrap();
    let action_server_available = r2r::Node::is_available(&client).unwrap();
    let done = Done::default();
    let task_done = done.clone();
    pool.spawner()
        .spawn_local(async move {
            action_server_available.await.expect("could not await action server");
            let goal = "{ \"order\": 1000 }";
            let (goal, result, mut feedback) = client
                .send_goal_request(serde_json::from_str(goal).expect("json malformed"))
                .expect("could not send goal request")
                .await
                .expect("goal rejected by server");
            while let Some(msg) = feedback.next().await {
                let msg = msg.unwrap();
                let sequence =
                    msg.get("sequence").and_then(|s| s.as_array()).expect("unexpected feedback msg");
                if sequence.len() == 4 {
                    goal.cancel().unwrap().await.unwrap();
                    break;
                }
            }
            // The server of this example accepts the request and lets go of the goal.
            let (status, msg) = result.await.expect("action failed");
            assert_eq!((status, msg.is_ok()), (r2r::GoalStatus::Canceled, true));
            task_done.set(vec![4]);
        })
        .unwrap();
    let mut spinning = node.lock().unwrap().context().clone();
    assert_eq!(run(&mut spinning, &mut pool, &done), [4]);
}
