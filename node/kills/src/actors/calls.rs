// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services, actions, and the parameter services of nodes: both ends.

use super::actor::Actor;
use crate::Result;
use crate::survivors::{ACTORS_ADD, ACTORS_FIBONACCI, ADD, PARAMETERS};
use futures::StreamExt;
use futures::executor::block_on;
use futures::future::select;
use std::pin::pin;
use std::thread;
use std::time::Duration;
use tautline::example_interfaces::action::Fibonacci;
use tautline::example_interfaces::srv::AddTwoInts;
use tautline::rcl_interfaces::msg;
use tautline::rcl_interfaces::srv::{GetParameters, SetParameters};
use tautline::{
    ActionServerGoalRequest, CallbackHandle, CallbackOptions, Node, ParameterValue, Qos, ServiceRequest,
};

/// Time limit of a request: longer than most actors live.
const LIMIT: Duration = Duration::from_millis(50);

fn end(callback: Option<CallbackHandle>) -> Result<()> {
    if let Some(callback) = callback {
        callback.stop();
        callback.join()?;
    }
    Ok(())
}

/// Answers requests: some late, some never.
fn serve(node: &mut Node, service: &str) -> Result<CallbackHandle> {
    let requests = node.create_service::<AddTwoInts::Service>(service, Qos::services_default())?.owned();
    let mut count = 0;
    let serve = requests.for_each(move |request: ServiceRequest<AddTwoInts::Service>| {
        count += 1;
        if count % 5 == 0 {
            thread::sleep(Duration::from_millis(3));
        }
        if count % 7 != 0 {
            let sum = request.message.a + request.message.b;
            // The client may not take its answers.
            let _ = request.respond(AddTwoInts::Response { sum });
        }
        async {}
    });
    Ok(node.spawn_callback(CallbackOptions::other().name("serve"), serve)?)
}

pub fn serve_and_ask(actor: &mut Actor) -> Result<()> {
    let _spinning = actor.spin();
    loop {
        let mut node = actor.node("services")?;
        let mut server = None;
        for _ in 0..=actor.up_to(10) {
            if actor.chance(0.4) {
                end(server.take())?;
                if actor.chance(0.8) {
                    let service = actor.one_of(&[ADD, ACTORS_ADD]);
                    server = Some(serve(&mut node, service)?);
                }
            }
            let service = actor.one_of(&[ADD, ACTORS_ADD]);
            let client = node.create_client::<AddTwoInts::Service>(service)?;
            for _ in 0..actor.up_to(4) {
                if let Ok(response) = client.request_timeout(&AddTwoInts::Request { a: 1, b: 2 }, LIMIT) {
                    // Some responses are not awaited.
                    if actor.chance(0.7) {
                        let _ = block_on(response);
                    }
                }
            }
            actor.rest();
        }
        end(server)?;
    }
}

async fn decide(request: ActionServerGoalRequest<Fibonacci::Action>) -> tautline::Result<()> {
    let order = request.goal.order;
    if order % 4 == 3 {
        return request.reject();
    }
    let (mut goal, mut cancels) = request.accept()?;
    for n in 0..order {
        goal.publish_feedback(Fibonacci::Feedback { sequence: vec![n] })?;
    }
    if order % 4 == 2 {
        // Waits until a client cancels the goal, or this process is killed.
        if let Some(cancel) = cancels.next().await {
            cancel.accept();
            return goal.cancel(Fibonacci::Result::default());
        }
    }
    goal.succeed(Fibonacci::Result { sequence: vec![order] })
}

/// Servers and clients of an action.
pub fn pursue(actor: &mut Actor) -> Result<()> {
    let _spinning = actor.spin();
    loop {
        let mut node = actor.node("actions")?;
        let goals = node.create_action_server::<Fibonacci::Action>(ACTORS_FIBONACCI)?;
        let pursue = goals.for_each_concurrent(None, |request| async {
            // The client may have ended.
            let _ = decide(request).await;
        });
        let server = node.spawn_callback(CallbackOptions::other().name("pursue"), pursue)?;
        let client = node.create_action_client::<Fibonacci::Action>(ACTORS_FIBONACCI)?;
        let mut timer = node.create_wall_timer(LIMIT)?;
        for _ in 0..=actor.up_to(4) {
            let order = actor.up_to(8) as i32;
            if let Ok(sent) = client.send_goal_request(Fibonacci::Goal { order }) {
                let asked = async {
                    let (goal, result, mut feedback) = sent.await?;
                    feedback.next().await;
                    if order % 4 == 2 {
                        goal.cancel()?.await?;
                    }
                    result.await.map(drop)
                };
                block_on(select(pin!(asked), pin!(timer.tick())));
            }
            actor.rest();
        }
        if actor.chance(0.5) {
            drop(client);
            end(Some(server))?;
        }
    }
}

/// Serves parameters of its own, which others set, and sets those of a survivor.
pub fn set_parameters(actor: &mut Actor) -> Result<()> {
    let _spinning = actor.spin();
    loop {
        let mut node = actor.node("parameters")?;
        let mut reader = node.declare_parameter("speed", 1_i64)?;
        let (answer, changes) = node.make_parameter_handler()?;
        node.spawn_callback(CallbackOptions::other().name("answer"), answer)?;
        node.spawn_callback(CallbackOptions::other().name("changes"), changes.for_each(|_| async {}))?;
        let of = actor.one_of(&[PARAMETERS, "/actors/parameters"]);
        let set = node.create_client::<SetParameters::Service>(&format!("{of}/set_parameters"))?;
        let get = node.create_client::<GetParameters::Service>(&format!("{of}/get_parameters"))?;
        for n in 0..=actor.up_to(6) as i64 {
            node.set_parameter("speed", n)?;
            let value = (&ParameterValue::Integer(n)).into();
            let parameters = vec![msg::Parameter { name: "speed".into(), value }];
            if let Ok(response) = set.request_timeout(&SetParameters::Request { parameters }, LIMIT) {
                let _ = block_on(response);
            }
            let names = vec!["speed".into()];
            if let Ok(response) = get.request_timeout(&GetParameters::Request { names }, LIMIT) {
                let _ = block_on(response);
            }
            reader.get();
            actor.rest();
        }
    }
}
