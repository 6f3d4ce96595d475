// SPDX-License-Identifier: MIT OR Apache-2.0
//! An action's server and its clients, typed and by name: feedback, result, cancelling, rejecting.

use futures::executor::{LocalPool, LocalSpawner};
use futures::future::{self, Either, FutureExt};
use futures::stream::{Stream, StreamExt};
use futures::task::LocalSpawnExt;
use r2r::GoalStatus;
use r2r::test_msgs::action::Fibonacci;
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

async fn run_goal(
    node: Arc<Mutex<r2r::Node>>,
    g: r2r::ActionServerGoal<Fibonacci::Action>,
) -> Fibonacci::Result {
    let mut timer = node
        .lock()
        .unwrap()
        .create_wall_timer(Duration::from_millis(20))
        .expect("could not create timer");
    let mut feedback_msg = Fibonacci::Feedback { sequence: vec![0, 1] };
    g.publish_feedback(feedback_msg.clone()).expect("fail");
    for i in 1..g.goal.order as usize {
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
        if req.goal.order < 0 {
            req.reject().expect("could not reject goal");
            continue;
        }
        let (mut g, mut cancel) = req.accept().expect("could not accept goal");
        let goal_fut = spawner.spawn_local_with_handle(run_goal(node.clone(), g.clone())).unwrap();
        match future::select(goal_fut, cancel.next()).await {
            Either::Left((result, _)) => {
                assert!(!g.is_cancelling().unwrap());
                g.succeed(result).expect("could not send result");
            }
            Either::Right((request, _)) => {
                if let Some(request) = request {
                    assert_eq!(request.uuid, g.uuid);
                    request.accept();
                    g.cancel(Fibonacci::Result { sequence: vec![-1] }).expect("could not cancel goal");
                }
            }
        };
    }
}

async fn typed(client: r2r::ActionClient<Fibonacci::Action>) {
    assert!(client.send_goal_request(Fibonacci::Goal { order: -1 }).unwrap().await.is_err());
    let (goal, result, feedback) = client
        .send_goal_request(Fibonacci::Goal { order: 5 })
        .expect("could not send goal request")
        .await
        .expect("goal rejected by server");
    assert_eq!(goal.uuid.as_bytes().len(), 16);
    // A stream of feedback need not end: as much as the goal tells.
    let told = feedback.take(2).collect::<Vec<_>>();
    let ((status, msg), told) = future::join(async { result.await.expect("action failed") }, told).await;
    assert_eq!((status, msg.sequence.as_slice()), (GoalStatus::Succeeded, &[0, 1, 1, 2, 3, 5][..]));
    assert!(told.iter().all(|told| msg.sequence.starts_with(&told.sequence)), "{told:?}");
    assert!(goal.get_status().is_ok());
}

async fn untyped_that_cancels(client: r2r::ActionClientUntyped) {
    let goal = "{ \"order\": 1000 }";
    let (goal, result, mut feedback) = client
        .send_goal_request(serde_json::from_str(goal).expect("json malformed"))
        .expect("could not send goal request")
        .await
        .expect("goal rejected by server");
    while let Some(msg) = feedback.next().await {
        let msg = msg.unwrap();
        let sequence = msg.get("sequence").and_then(|s| s.as_array()).expect("unexpected feedback msg");
        if sequence.len() == 4 {
            goal.cancel().unwrap().await.unwrap();
            break;
        }
    }
    let (status, msg) = result.await.expect("action failed");
    assert_eq!(status, GoalStatus::Canceled);
    assert_eq!(msg.unwrap(), serde_json::json!({ "sequence": [-1] }));
}

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    let ctx = r2r::Context::create()?;
    let node = Arc::new(Mutex::new(r2r::Node::create(ctx, "testnode", "")?));
    let requests = node.lock().unwrap().create_action_server::<Fibonacci::Action>("/fibonacci")?;
    spawner.spawn_local(fibonacci_server(spawner.clone(), node.clone(), requests))?;

    let client = node.lock().unwrap().create_action_client::<Fibonacci::Action>("/fibonacci")?;
    let by_name =
        node.lock().unwrap().create_action_client_untyped("/fibonacci", "test_msgs/action/Fibonacci")?;
    let available = [r2r::Node::is_available(&client)?.boxed_local(), r2r::Node::is_available(&by_name)?.boxed_local()];
    let is_done = Rc::new(RefCell::new(false));
    let task_is_done = is_done.clone();
    spawner.spawn_local(async move {
        future::try_join_all(available).await.expect("could not await action server");
        typed(client).await;
        untyped_that_cancels(by_name).await;
        *task_is_done.borrow_mut() = true;
    })?;
    while !*is_done.borrow() {
        node.lock().unwrap().spin_once(Duration::from_millis(10));
        pool.run_until_stalled();
    }
    Ok(())
}
