// SPDX-License-Identifier: MIT OR Apache-2.0
//! The subscriber: five subscriptions of one node, executed as the variant says.
//!
//! The middleware's threads are made with the context and the node, and inherit what the main thread is then.

use std::sync::Arc;
use std::time::Duration;

use r2r::std_msgs::msg::UInt64;
use r2r::{Context, Node, QosProfile};
use tautline_paper::{Job, Sampler, Subscriber, callback, structures};

use rival_r2r::Result;

pub fn run(job: &Job) -> Result<()> {
    let mut subscriber = Subscriber::new(job)?;
    let mut node = Node::create(Context::create()?, "subscriber", &job.namespace)?;
    let mut callbacks = Vec::new();
    for (topic, log) in job.topics.iter().zip(subscriber.logs()) {
        let qos = QosProfile::default().keep_last(topic.depth);
        let messages = node.subscribe::<UInt64>(&topic.full_name(job), qos)?;
        callbacks.push(callback(topic, Arc::clone(log), messages, |message| message.data));
    }
    let node = structures::run(job, &mut subscriber, Spinning(node), callbacks)?;
    subscriber.finish(&[]);
    drop(node);
    Ok(())
}

struct Spinning(Node);

impl Sampler for Spinning {
    fn spin_once(&mut self, timeout: Duration) {
        self.0.spin_once(timeout);
    }
}
