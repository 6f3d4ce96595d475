//! An action: a goal that is pursued with feedback, one that is cancelled on the way, and one that is rejected.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use futures::future::{Either, select};
use std::pin::pin;
use std::process::ExitCode;
use tautline::example_interfaces::action::Fibonacci;
use tautline::{ActionClient, ActionServerGoal, ActionServerGoalRequest, CallbackOptions, Node, Result};
use tautline_examples::{context, exit_code};

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "action", "")?;
    let goals = node.create_action_server::<Fibonacci::Action>("fibonacci")?;
    let client = node.create_action_client::<Fibonacci::Action>("fibonacci")?;
    let available = client.wait_for_action_server()?;
    // Several goals at once: each is a future of its own.
    let serve = goals.for_each_concurrent(None, |request| async {
        if let Err(error) = decide(request).await {
            println!("server: {error}");
        }
    });
    let serve = node.spawn_callback(CallbackOptions::other().name("pursue"), serve)?;
    let ask = node.spawn_callback(CallbackOptions::other().name("ask"), async move {
        if let Err(error) = available.await {
            println!("{error}");
        }
        for order in [5, 1000, 0] {
            if let Err(error) = ask(&client, order).await {
                println!("order {order}: {error}");
            }
        }
        context.shutdown();
    })?;
    node.spin()?;
    serve.stop(); // it would wait for more
    serve.join()?;
    Ok(ask.join()?)
}

async fn decide(request: ActionServerGoalRequest<Fibonacci::Action>) -> Result<()> {
    if request.goal.order < 1 {
        return request.reject();
    }
    let (mut goal, mut cancel_requests) = request.accept()?;
    let work = goal.clone();
    match select(pin!(pursue(&work)), cancel_requests.next()).await {
        Either::Left((sequence, _)) => goal.succeed(Fibonacci::Result { sequence: sequence? }),
        Either::Right((Some(request), _)) => {
            request.accept();
            goal.cancel(Fibonacci::Result::default())
        }
        Either::Right((None, _)) => Ok(()), // the goal has ended
    }
}

async fn pursue(goal: &ActionServerGoal<Fibonacci::Action>) -> Result<Vec<i32>> {
    let mut sequence = vec![0, 1];
    for n in 1..goal.goal.order as usize {
        if n == 6 {
            futures::future::pending::<()>().await; // as work that takes long
        }
        sequence.push(sequence[n] + sequence[n - 1]);
        goal.publish_feedback(Fibonacci::Feedback { sequence: sequence.clone() })?;
    }
    Ok(sequence)
}

async fn ask(client: &ActionClient<Fibonacci::Action>, order: i32) -> Result<()> {
    let (goal, result, mut feedback) = client.send_goal_request(Fibonacci::Goal { order })?.await?;
    while let Some(feedback) = feedback.next().await {
        println!("order {order}: {:?}", feedback.sequence);
        if feedback.sequence.len() == 7 {
            goal.cancel()?.await?;
        }
    }
    let (status, result) = result.await?;
    println!("order {order}: {status} with {:?}", result.sequence);
    Ok(())
}
