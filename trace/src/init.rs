// SPDX-License-Identifier: MIT OR Apache-2.0
//! Descriptions that are recorded once, when an object is created. Setup only: these functions take a lock
//! and allocate.

use crate::description::ObjectKind;
use crate::event::ObjectId;
#[cfg(feature = "lttng")]
use crate::lttng;
use crate::object::Object;
use crate::register::register_thread;
use std::cell::Cell;

thread_local!(static NODE: Cell<ObjectId> = const { Cell::new(ObjectId::NONE) });

/// While this exists, objects that the current thread creates belong to a node.
#[derive(Debug)]
#[must_use = "only what is made while it lives belongs to the node"]
pub struct NodeScope {
    before: ObjectId,
}

/// Assigns the objects that the current thread creates next to `node`.
pub fn in_node(node: ObjectId) -> NodeScope {
    NodeScope { before: NODE.replace(node) }
}

impl Drop for NodeScope {
    fn drop(&mut self) {
        NODE.set(self.before);
    }
}

/// A membership of `domain` was made.
pub fn context_init(domain: u32) -> Object {
    let name = format!("domain {domain}");
    let context = Object::describe(ObjectKind::Context, ObjectId::NONE, domain.into(), [0; 2], &name);
    #[cfg(feature = "lttng")]
    lttng::context_init(context.id());
    context
}

/// A node was made.
pub fn node_init(context: ObjectId, name: &str, namespace: &str) -> Object {
    let full = format!("{}/{name}", namespace.trim_end_matches('/'));
    let node = Object::describe(ObjectKind::Node, context, 0, [0; 2], &full);
    #[cfg(feature = "lttng")]
    lttng::node_init(context, node.id(), name, namespace);
    node
}

/// A sampler, as an object of events.
#[derive(Debug)]
#[must_use = "dropping it removes the description from the trace"]
pub struct SamplerObject {
    object: Object,
    #[cfg(feature = "lttng")]
    node: std::sync::Arc<std::sync::atomic::AtomicU64>,
}

impl SamplerObject {
    pub(crate) fn id(&self) -> ObjectId {
        self.object.id()
    }

    /// The node of LTTng's spin events: r2r spins nodes, so it is the context's first node. None before there is one.
    #[cfg(feature = "lttng")]
    pub(crate) fn node(&self) -> ObjectId {
        ObjectId(self.node.load(std::sync::atomic::Ordering::Relaxed))
    }
}

/// A sampler was created, or a thread that waits in place of a sampler.
pub fn sampler_init(context: ObjectId, name: &str) -> SamplerObject {
    let object = Object::describe(ObjectKind::Sampler, context, 0, [0; 2], name);
    SamplerObject {
        object,
        #[cfg(feature = "lttng")]
        node: lttng::node_of(context),
    }
}

/// A publisher was made, by the node of the current [`NodeScope`].
pub fn publisher_init(topic: &str, depth: usize, gid: [u64; 2]) -> Object {
    register_thread();
    let publisher = Object::describe(ObjectKind::Publisher, NODE.get(), depth as u64, gid, topic);
    #[cfg(feature = "lttng")]
    lttng::publisher_init(publisher.id(), NODE.get(), topic, depth, gid);
    publisher
}

/// A subscription was made, by the node of the current [`NodeScope`].
pub fn subscription_init(topic: &str, depth: usize) -> Object {
    register_thread();
    let subscription = Object::describe(ObjectKind::Subscription, NODE.get(), depth as u64, [0; 2], topic);
    #[cfg(feature = "lttng")]
    lttng::subscription_init(subscription.id(), NODE.get(), topic, depth);
    subscription
}

/// A mirror has created its sender of one publisher's messages to a network.
pub fn sender_init(topic: &str, gid: [u64; 2]) -> Object {
    Object::describe(ObjectKind::Sender, ObjectId::NONE, 0, gid, topic)
}

/// A timer was made, by the node of the current [`NodeScope`].
pub fn timer_init(period_ns: u64) -> Object {
    let timer = Object::describe(ObjectKind::Timer, NODE.get(), period_ns, [0; 2], "");
    #[cfg(feature = "lttng")]
    lttng::timer_init(timer.id(), NODE.get(), period_ns);
    timer
}

/// A callback of a subscription was made.
pub fn subscription_callback_init(subscription: ObjectId, name: &str) -> Object {
    let callback = Object::describe(ObjectKind::Callback, subscription, 0, [0; 2], name);
    #[cfg(feature = "lttng")]
    lttng::subscription_callback_init(subscription, callback.id(), name);
    callback
}

/// A callback of a timer was made.
pub fn timer_callback_init(timer: ObjectId, name: &str) -> Object {
    let callback = Object::describe(ObjectKind::Callback, timer, 0, [0; 2], name);
    #[cfg(feature = "lttng")]
    lttng::timer_callback_init(timer, callback.id(), name);
    callback
}

/// A callback of another source was created, or a thread for callbacks. It and its events are not reported to LTTng: in
/// ROS 2 each callback belongs to a subscription, a timer or a service.
pub fn callback_init(name: &str) -> Object {
    Object::describe(ObjectKind::Callback, ObjectId::NONE, 0, [0; 2], name)
}
