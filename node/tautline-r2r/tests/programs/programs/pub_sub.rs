// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishers and subscribers in one thread that spins and runs a pool: every other message goes on to a second topic.

use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use futures::{future, stream::StreamExt};
use r2r::{QosProfile, std_msgs::msg};
use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "testnode", "demo")?;
    assert_eq!(node.name()?, "testnode");
    assert_eq!(node.fully_qualified_name()?, "/demo/testnode");
    let qos = QosProfile::default().reliable().keep_last(10);

    let mut sub = node.subscribe::<msg::String>("/topic", qos.clone())?;
    let forward = node.create_publisher::<msg::String>("topic2", qos.clone())?;
    let sub2 = node.subscribe::<msg::String>("/demo/topic2", qos.clone())?;
    let source = node.create_publisher::<msg::String>("/topic", qos)?;
    let mut timer = node.create_wall_timer(Duration::from_millis(10))?;
    let matched = source.wait_for_inter_process_subscribers()?;
    let matched2 = forward.wait_for_inter_process_subscribers()?;

    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    spawner.spawn_local(async move {
        let mut x: i32 = 0;
        while let Some(msg) = sub.next().await {
            if x % 2 == 0 {
                forward.publish(&msg::String { data: format!("({x}): {}", msg.data) }).unwrap();
            }
            x += 1;
        }
    })?;
    let heard = Rc::new(RefCell::new(Vec::new()));
    let log = heard.clone();
    spawner.spawn_local(sub2.for_each(move |msg| {
        log.borrow_mut().push(msg.data);
        future::ready(())
    }))?;
    spawner.spawn_local(async move {
        matched.await.unwrap();
        matched2.await.unwrap();
        assert!(source.get_inter_process_subscription_count().unwrap() > 0);
        for count in 0.. {
            timer.tick().await.unwrap();
            source.publish(&msg::String { data: format!("Hello, world! ({count})") }).unwrap();
        }
    })?;
    while heard.borrow().len() < 3 {
        node.spin_once(Duration::from_millis(100));
        pool.run_until_stalled();
    }
    let expected = [0, 2, 4].map(|x| format!("({x}): Hello, world! ({x})"));
    assert_eq!(heard.borrow()[..3], expected);

    let unused = node.create_publisher::<msg::Int32>("/unused", QosProfile::default())?;
    node.destroy_publisher(unused);
    Ok(())
}
