// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node that tasks of a multi-threaded tokio share: topic, service and client, and a thread for blocking work that spins.

use futures::stream::StreamExt;
use r2r::QosProfile;
use r2r::std_srvs::srv::SetBool;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::task;

type Shared = Arc<Mutex<r2r::Node>>;

#[tokio::main(flavor = "multi_thread", worker_threads = 4)]
pub async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let node = r2r::Node::create(ctx, "testnode", "")?;
    let arc_node = Arc::new(Mutex::new(node));

    let an = arc_node.clone();
    let subscriber = task::spawn(async move { subscriber(an).await.unwrap() });
    let an = arc_node.clone();
    task::spawn(async move { publisher(an).await.unwrap() });
    let an = arc_node.clone();
    let client = task::spawn(async move { client(an).await.unwrap() });
    let an = arc_node.clone();
    task::spawn(async move { service(an).await.unwrap() });

    let is_done = Arc::new(AtomicBool::new(false));
    let stop = is_done.clone();
    let handle = task::spawn_blocking(move || {
        while !stop.load(Ordering::Relaxed) {
            {
                arc_node.lock().unwrap().spin_once(Duration::from_millis(10));
            }
            std::thread::sleep(Duration::from_millis(1))
        }
    });
    assert_eq!(client.await?, ["off", "on", "off", "on", "off"]);
    assert!(subscriber.await?);
    is_done.store(true, Ordering::Relaxed);
    handle.await?;
    Ok(())
}

async fn subscriber(arc_node: Shared) -> Result<bool, r2r::Error> {
    let mut sub = arc_node
        .lock()
        .unwrap()
        .subscribe::<r2r::std_msgs::msg::String>("/topic", QosProfile::default())?;
    Ok(sub.next().await.is_some_and(|msg| msg.data == "hello from r2r"))
}

async fn publisher(arc_node: Shared) -> Result<(), r2r::Error> {
    let (mut timer, publisher) = {
        let mut node = arc_node.lock().unwrap();
        let timer = node.create_wall_timer(Duration::from_millis(20))?;
        let publisher =
            node.create_publisher::<r2r::std_msgs::msg::String>("/topic", QosProfile::default())?;
        (timer, publisher)
    };
    loop {
        timer.tick().await?;
        let msg = r2r::std_msgs::msg::String { data: "hello from r2r".to_string() };
        publisher.publish(&msg)?;
    }
}

async fn client(arc_node: Shared) -> Result<Vec<String>, r2r::Error> {
    let (client, mut timer, service_available) = {
        let mut node = arc_node.lock().unwrap();
        let client = node.create_client::<SetBool::Service>("/set_bool", QosProfile::default())?;
        let timer = node.create_wall_timer(Duration::from_millis(10))?;
        let service_available = r2r::Node::is_available(&client)?;
        (client, timer, service_available)
    };
    service_available.await?;
    let mut answers = Vec::new();
    for i in 0..5 {
        let req = SetBool::Request { data: i % 2 == 1 };
        let resp = client.request(&req)?.await?;
        assert!(resp.success);
        answers.push(resp.message);
        timer.tick().await?;
    }
    Ok(answers)
}

async fn service(arc_node: Shared) -> Result<(), r2r::Error> {
    let mut service = {
        let mut node = arc_node.lock().unwrap();
        node.create_service::<SetBool::Service>("/set_bool", QosProfile::default())?
    };
    while let Some(req) = service.next().await {
        let message = if req.message.data { "on" } else { "off" }.to_string();
        req.respond(SetBool::Response { success: true, message }).expect("could not send service response");
    }
    Ok(())
}
