// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node with the endpoints that every node of rclcpp has: a publisher of /rosout, a publisher and a subscription of
//! /parameter_events, six services for its parameters and one that describes types.

use crate::Result;
use crate::job::{DOMAIN, wait_until};
use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt};
use std::thread::sleep;
use std::time::Duration;
use tautline::rcl_interfaces::msg::{Log, ParameterEvent};
use tautline::type_description_interfaces::srv::GetTypeDescription;
use tautline::{
    CallbackHandle, CallbackOptions, Claim, Context, Limits, Node, Publisher, Qos, Realtime, Server,
    Subscription,
};
use tautline_rt::clock::monotonic_ns;

/// How many endpoints that is, a service counted as one.
pub const ENDPOINTS: usize = 10;
/// How long all of them may take to be matched.
const PATIENCE: Duration = Duration::from_secs(120);
/// How often it is looked whether they are: not so often that it is in the way.
const GLANCE: Duration = Duration::from_millis(10);

pub struct RosNode {
    _rosout: Publisher<Log>,
    changes: Publisher<ParameterEvent>,
    changes_of_all: Subscription<ParameterEvent>,
    _description: Server<GetTypeDescription::Service>,
    node: Node,
}

/// Seldom used, and by no real-time thread.
pub fn seldom() -> Limits {
    Limits { claim: Claim::OnUse, ..Limits::default() }
}

pub fn context() -> Result<Context> {
    Ok(Context::builder().domain(DOMAIN).realtime(Realtime::Off).hold_idle(false).build()?)
}

pub fn spin_while(context: &Context, work: impl FnOnce() -> Result<()>) -> Result<()> {
    let spinning = context.clone();
    let sampler = std::thread::spawn(move || spinning.spin());
    work()?;
    context.shutdown();
    Ok(sampler.join().map_err(|_| "the sampler panicked")??)
}

impl RosNode {
    /// The node, and what answers the requests for its parameters.
    pub fn create(context: &Context, name: &str) -> Result<(Self, BoxFuture<'static, ()>)> {
        let mut node = Node::create(context.clone(), name, "")?;
        for topic in ["/rosout", "/parameter_events"] {
            node.set_topic_limits(topic, seldom())?;
        }
        let rosout = Qos::keep_last(1000).transient_local().lifespan(Duration::from_secs(10));
        let rosout = node.create_publisher("/rosout", rosout)?;
        let changes = node.create_publisher("/parameter_events", Qos::parameter_events())?;
        let changes_of_all = node.subscribe("/parameter_events", Qos::parameter_events())?;
        node.set_service_limits("~/get_type_description", seldom())?;
        let description = Qos::services_default();
        let description = node.create_service("~/get_type_description", description)?;
        let (answers, changed) = node.make_parameter_handler()?;
        let answers = futures::future::join(answers, changed.for_each(|_| async {})).map(drop).boxed();
        Ok((RosNode { _rosout: rosout, changes, changes_of_all, _description: description, node }, answers))
    }

    pub fn serve(&self, answers: BoxFuture<'static, ()>) -> Result<CallbackHandle> {
        let options = CallbackOptions::fifo(tautline_exchange::APPLICATION_PRIORITY).name("parameters");
        Ok(self.node.spawn_callback(options, answers)?)
    }

    /// Whether it is matched with the nodes of so many processes, this one included.
    pub fn is_matched(&self, nodes: usize) -> bool {
        self.changes.subscription_count() >= nodes && self.changes_of_all.publisher_count() >= nodes
    }

    /// Waits until it is, and says when that was seen.
    pub fn wait_until_matched(&self, nodes: usize) -> Result<u64> {
        let is_matched = || Ok(self.is_matched(nodes));
        let waited = wait_until("a node is matched", PATIENCE, || sleep(GLANCE), is_matched);
        waited.map_err(|error| {
            let (publishers, subscriptions) =
                (self.changes_of_all.publisher_count(), self.changes.subscription_count());
            format!("{error}: it is with {subscriptions} subscriptions and {publishers} publishers instead of {nodes}")
        })?;
        Ok(monotonic_ns())
    }
}
