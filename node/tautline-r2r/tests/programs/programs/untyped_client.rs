// SPDX-License-Identifier: MIT OR Apache-2.0
//! A client of a service whose type it knows by name.

use futures::{Future, StreamExt, executor::LocalPool, task::LocalSpawnExt};
use r2r::{QosProfile, std_srvs::srv::SetBool};
use std::cell::RefCell;
use std::rc::Rc;

async fn requester_task(
    node_available: impl Future<Output = r2r::Result<()>>,
    c: r2r::ClientUntyped,
) -> Result<Vec<serde_json::Value>, Box<dyn std::error::Error>> {
    node_available.await?;
    let mut answers = Vec::new();
    for data in ["true", "false"] {
        let json = format!("{{ \"data\": {data} }}");
        let req = serde_json::from_str(&json).unwrap();
        let resp = c.request(req)?.await?;
        answers.push(resp.expect("deserialization error"));
    }
    Ok(answers)
}

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "testnode", "")?;
    let service = node.create_service::<SetBool::Service>("/set_bool", QosProfile::default())?;
    let client =
        node.create_client_untyped("/set_bool", "std_srvs/srv/SetBool", QosProfile::default())?;
    let service_available = r2r::Node::is_available(&client)?;
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    spawner.spawn_local(service.for_each(|req: r2r::ServiceRequest<SetBool::Service>| {
        let success = req.message.data;
        req.respond(SetBool::Response { success, message: "done".into() }).unwrap();
        futures::future::ready(())
    }))?;
    let answers = Rc::new(RefCell::new(None));
    let result = answers.clone();
    spawner.spawn_local(async move {
        *result.borrow_mut() = Some(requester_task(service_available, client).await.unwrap());
    })?;
    while answers.borrow().is_none() {
        node.spin_once(std::time::Duration::from_millis(100));
        pool.run_until_stalled();
    }
    let answer = |success| serde_json::json!({ "success": success, "message": "done" });
    assert_eq!(answers.borrow().as_deref().unwrap(), [answer(true), answer(false)]);
    Ok(())
}
