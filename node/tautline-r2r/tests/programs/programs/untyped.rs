// SPDX-License-Identifier: MIT OR Apache-2.0
//! An echo of a topic whose type is found in the graph: messages as JSON.

use futures::executor::LocalPool;
use futures::{future, stream::StreamExt, task::LocalSpawnExt};
use r2r::QosProfile;
use r2r::geometry_msgs::msg::{Point, Polygon};
use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "echo", "")?;
    let topic = "/polygon";
    let publisher = node.create_publisher::<Polygon>(topic, QosProfile::default())?;

    let nt = loop {
        let nt = node.get_topic_names_and_types()?;
        if nt.contains_key(topic) {
            break nt;
        }
        node.spin_once(Duration::from_millis(10));
    };
    let type_name = nt.get(topic).and_then(|types| types.first()).expect("a type");
    assert_eq!(type_name, "geometry_msgs/msg/Polygon");
    let ends = node.get_publishers_info_by_topic(topic, false)?;
    assert_eq!((ends[0].node_name.as_str(), ends[0].topic_type.as_str()), ("echo", type_name.as_str()));

    let echo = &format!("{topic}_echo");
    let echo_pub = node.create_publisher_untyped(echo, type_name, QosProfile::default())?;
    let sub = node.subscribe_untyped(topic, type_name, QosProfile::default())?;
    let echoed = node.subscribe::<Polygon>(echo, QosProfile::default())?;
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    spawner.spawn_local(async move {
        sub.for_each(|msg| {
            match msg {
                Ok(msg) => echo_pub.publish(msg).unwrap(),
                Err(err) => panic!("Could not parse msg. {err}"),
            }
            future::ready(())
        })
        .await
    })?;
    let heard = Rc::new(RefCell::new(None));
    let log = heard.clone();
    spawner.spawn_local(echoed.for_each(move |msg| {
        *log.borrow_mut() = Some(msg);
        future::ready(())
    }))?;
    let points = vec![r2r::geometry_msgs::msg::Point32 { x: 0.5, y: -1.0, z: 2.25 }; 3];
    let polygon = Polygon { points };
    while heard.borrow().is_none() {
        publisher.publish(&polygon)?;
        node.spin_once(Duration::from_millis(20));
        pool.run_until_stalled();
    }
    assert_eq!(heard.borrow().as_ref(), Some(&polygon));
    assert_eq!(Point::default(), Point { x: 0.0, y: 0.0, z: 0.0 });
    Ok(())
}
