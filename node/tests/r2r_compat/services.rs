// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs in the style of r2r 0.9.7's examples `service`, `client` and `untyped_client`.

use crate::{Done, run};
use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use futures::{Future, FutureExt, StreamExt, select};
use r2r::QosProfile;
use r2r::example_interfaces::srv::AddTwoInts;
use tautline as r2r;

async fn requester_task(
    node_available: impl Future<Output = r2r::Result<()>>,
    c: r2r::Client<AddTwoInts::Service>,
) -> Result<Vec<i64>, Box<dyn std::error::Error>> {
    let mut sums = vec![];
    node_available.await?;
    for x in 0..5 {
        let req = AddTwoInts::Request { a: 10 * x, b: x };
        let resp = c.request(&req)?.await?;
        sums.push(resp.sum);
    }
    Ok(sums)
}

/// A service that passes its requests on to another one, which answers after a while.
#[test]
fn chained_services() {
    let ctx = crate::context(57, "");
    let mut node = r2r::Node::create(ctx, "testnode", "").unwrap();
    let qos = QosProfile::default();
    let mut service = node.create_service::<AddTwoInts::Service>("/add_two_ints", qos).unwrap();
    let service_delayed = node.create_service::<AddTwoInts::Service>("/add_two_ints_delayed", qos).unwrap();
    let client = node.create_client::<AddTwoInts::Service>("/add_two_ints_delayed", qos).unwrap();
    let mut timer2 = node.create_wall_timer(std::time::Duration::from_millis(2)).unwrap();
    let service_available = r2r::Node::is_available(&client).unwrap();
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();

    spawner
        .spawn_local(async move {
            service_available.await.expect("could not await service");
            while let Some(req) = service.next().await {
                let resp = client
                    .request(&req.message)
                    .expect("could not send client response")
                    .await
                    .expect("expected client response");
                req.respond(resp).expect("could not send service response");
            }
        })
        .unwrap();

    spawner
        .spawn_local(async move {
            let mut service_delayed = service_delayed.fuse();
            loop {
                select! {
                    req = service_delayed.next() => {
                        if let Some(req) = req {
                            let resp = AddTwoInts::Response { sum: req.message.a + req.message.b };
                            let _ret = timer2.tick().await;
                            req.respond(resp).expect("could not send service response");
                        }
                    },
                    elapsed = timer2.tick().boxed_local().fuse() => {
                        assert!(elapsed.is_ok());
                    }
                };
            }
        })
        .unwrap();

    let asking = node.create_client::<AddTwoInts::Service>("/add_two_ints", qos).unwrap();
    let available = r2r::Node::is_available(&asking).unwrap();
    let done = Done::default();
    let result = done.clone();
    spawner
        .spawn_local(async move {
            result.set(requester_task(available, asking).await.unwrap());
        })
        .unwrap();
    assert_eq!(run(&mut node, &mut pool, &done), [0, 11, 22, 33, 44]);
}

#[cfg(feature = "untyped")]
#[test]
fn untyped_client() {
    async fn requester_task(
        node_available: impl Future<Output = r2r::Result<()>>,
        c: r2r::ClientUntyped,
    ) -> Result<Vec<i64>, Box<dyn std::error::Error>> {
        node_available.await?;
        let mut sums = vec![];
        for x in 0..3 {
            let json = format!("{{ \"a\": {}, \"b\": {} }}", 10 * x, x);
            let req = serde_json::from_str(&json).unwrap();
            let resp = c.request(req)?.await?;
            sums.push(resp.expect("deserialization error")["sum"].as_i64().unwrap());
        }
        Ok(sums)
    }
    let ctx = crate::context(58, "");
    let mut node = r2r::Node::create(ctx, "testnode", "").unwrap();
    let service = node.create_service::<AddTwoInts::Service>("/add_two_ints", QosProfile::default()).unwrap();
    let client = node
        .create_client_untyped("/add_two_ints", "example_interfaces/srv/AddTwoInts", QosProfile::default())
        .unwrap();
    let service_available = r2r::Node::is_available(&client).unwrap();
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    spawner
        .spawn_local(service.for_each(|req: r2r::ServiceRequest<AddTwoInts::Service>| {
            let sum = req.message.a + req.message.b;
            req.respond(AddTwoInts::Response { sum }).unwrap();
            futures::future::ready(())
        }))
        .unwrap();
    let done = Done::default();
    let result = done.clone();
    spawner
        .spawn_local(async move { result.set(requester_task(service_available, client).await.unwrap()) })
        .unwrap();
    assert_eq!(run(&mut node, &mut pool, &done), [0, 11, 22]);
}
