// SPDX-License-Identifier: MIT OR Apache-2.0
//! A service that asks another one before it answers.

use futures::{Future, FutureExt, executor::LocalPool, select, stream::StreamExt, task::LocalSpawnExt};
use r2r::{QosProfile, std_srvs::srv::SetBool};
use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

async fn requester_task(
    node_available: impl Future<Output = r2r::Result<()>>,
    c: r2r::Client<SetBool::Service>,
) -> Result<Vec<String>, Box<dyn std::error::Error>> {
    let mut answers = Vec::new();
    node_available.await?;
    for x in 0..4 {
        let req = SetBool::Request { data: x % 2 == 0 };
        let resp = c.request(&req)?.await?;
        answers.push(resp.message);
    }
    Ok(answers)
}

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "testnode", "")?;
    let mut service = node.create_service::<SetBool::Service>("/set", QosProfile::default())?;
    let service_delayed = node.create_service::<SetBool::Service>("/set_delayed", QosProfile::default())?;
    let client = node.create_client::<SetBool::Service>("/set_delayed", QosProfile::default())?;
    let asking = node.create_client::<SetBool::Service>("/set", QosProfile::default())?;
    let mut timer = node.create_wall_timer(Duration::from_millis(5))?;
    let mut timer2 = node.create_wall_timer(Duration::from_millis(10))?;
    let service_available = r2r::Node::is_available(&client)?;
    let asked_available = r2r::Node::is_available(&asking)?;
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();

    spawner.spawn_local(async move {
        service_available.await.expect("could not await service");
        while let Some(req) = service.next().await {
            let resp = client
                .request(&req.message)
                .expect("could not send client response")
                .await
                .expect("expected client response");
            req.respond(resp).expect("could not send service response");
        }
    })?;

    spawner.spawn_local(async move {
        // Streams are fused for select.
        let mut service_delayed = service_delayed.fuse();
        loop {
            select! {
                req = service_delayed.next() => {
                    if let Some(req) = req {
                        let message = format!("set to {}", req.message.data);
                        let _ret = timer2.tick().await;
                        req.respond(SetBool::Response { success: true, message }).expect("could not respond");
                    }
                },
                elapsed = timer2.tick().fuse() => {
                    if let Ok(elapsed) = elapsed {
                        assert!(!elapsed.is_zero());
                    }
                }
            };
        }
    })?;

    spawner.spawn_local(async move {
        loop {
            timer.tick().await.expect("could not tick");
        }
    })?;

    let answers = Rc::new(RefCell::new(None));
    let result = answers.clone();
    spawner.spawn_local(async move {
        *result.borrow_mut() = Some(requester_task(asked_available, asking).await.unwrap());
    })?;
    while answers.borrow().is_none() {
        node.spin_once(Duration::from_millis(5));
        pool.run_until_stalled();
    }
    let expected = ["set to true", "set to false", "set to true", "set to false"];
    assert_eq!(answers.borrow().as_deref().unwrap(), expected);
    Ok(())
}
