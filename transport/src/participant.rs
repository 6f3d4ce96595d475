// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's membership of a domain: its iceoryx2 node, its doorbell, its janitor.

use crate::dead_nodes;
use crate::doorbell::{Doorbell, Slot};
use crate::error::TransportError;
use crate::graph::Graph;
use crate::header::Gid;
use crate::janitor::Janitor;
use crate::nodes::{self, Entry, Ownership, Registry, Watchers};
use crate::publisher::RawPublisher;
use crate::qos::{Limits, Qos};
use crate::subscription::RawSubscription;
use crate::topic::IoxNode;
use crate::topic_type::TopicType;
use crate::typed::{Publisher, Subscription};
use iceoryx2::prelude::*;
use std::sync::Arc;
use tautline_msgs::Message;

/// Greatest domain number, as in ROS 2.
pub const MAX_DOMAIN: u32 = 232;

/// Membership of a domain. Processes see each other's topics if they are in the same domain, on the same host, as the
/// same user. A clone is the same membership.
#[derive(Clone)]
pub struct Participant {
    pub(crate) shared: Arc<Shared>,
    /// Whose the publishers and subscriptions are that this one creates.
    pub(crate) node: Option<Arc<Entry>>,
}

pub(crate) struct Shared {
    pub(crate) domain: u32,
    pub(crate) doorbell: Arc<Doorbell>,
    pub(crate) janitor: Janitor,
    pub(crate) graph: Arc<Graph>,
    pub(crate) registry: Arc<Registry>,
    pub(crate) watchers: Watchers,
    pub(crate) node: Arc<IoxNode>,
    trace: tautline_trace::Object,
    // Last: what is told to it must not outlive it.
    _tracing: tautline_trace::Membership,
}

impl Participant {
    /// Joins `domain`: makes an iceoryx2 node and a doorbell, starts the janitor (an ordinary, low-priority thread that
    /// cleans up after processes that died and serves late joiners).
    ///
    /// Sets iceoryx2's log level, which is the process's, to fatal: what it would print comes back as an error here.
    ///
    /// # Real-time
    /// Setup only: allocates, starts a thread.
    ///
    /// # Errors
    /// [`TransportError`]: shared memory cannot be made or belongs to another user.
    pub fn new(domain: u32) -> Result<Self, TransportError> {
        if domain > MAX_DOMAIN {
            return Err(TransportError::DomainRange { domain, max: MAX_DOMAIN });
        }
        let tracing = tautline_trace::join(domain)?;
        let node = Arc::new(open_node(domain)?);
        let doorbell = Doorbell::create(domain)?;
        let graph = Graph::open(domain)?;
        dead_nodes::remove(&node, &graph);
        nodes::remove_dead_files(domain, &graph);
        let registry = Registry::new(domain, doorbell.arena().id(), graph.clone());
        let janitor =
            Janitor::start(domain, doorbell.clone(), graph.clone(), registry.clone(), node.clone())?;
        let trace = tautline_trace::context_init(domain);
        let watchers = Watchers::new(graph.clone());
        let shared =
            Shared { domain, doorbell, janitor, graph, registry, watchers, node, trace, _tracing: tracing };
        Ok(Participant { shared: Arc::new(shared), node: None })
    }

    /// The domain.
    pub fn domain(&self) -> u32 {
        self.shared.domain
    }

    /// What trace events call this participant.
    pub fn trace_id(&self) -> tautline_trace::ObjectId {
        self.shared.trace.id()
    }

    /// The doorbell that announces samples to this participant's sampler.
    pub fn doorbell(&self) -> &Arc<Doorbell> {
        &self.shared.doorbell
    }

    /// Says that a port is this one's node's, if there is one.
    pub(crate) fn own(&self, gid: Gid) -> Result<Option<Ownership>, TransportError> {
        self.node.as_ref().map(|node| node.own(gid)).transpose()
    }

    /// Claims a slot for a timer or a guard condition.
    ///
    /// # Errors
    /// [`TransportError::Slots`] if all are taken.
    pub fn claim_slot(&self) -> Result<Slot, TransportError> {
        self.shared.doorbell.claim()
    }

    /// Creates a publisher of `topic`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: another type, a limit, a QoS that cannot be kept.
    pub fn create_publisher<T: Message>(
        &self,
        topic: &str,
        qos: Qos,
        limits: Limits,
    ) -> Result<Publisher<T>, TransportError> {
        Publisher::create(self, topic, qos, limits)
    }

    /// Creates a subscription of `topic`, a fully qualified name. What is published from now on is queued.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: another type, a limit, a QoS that cannot be kept.
    pub fn create_subscription<T: Message>(
        &self,
        topic: &str,
        qos: Qos,
        limits: Limits,
    ) -> Result<Subscription<T>, TransportError> {
        Subscription::create(self, topic, qos, limits)
    }

    /// Creates a publisher of bytes of `topic`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: another type, a limit, a QoS that cannot be kept.
    pub fn create_raw_publisher(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawPublisher, TransportError> {
        RawPublisher::create(self, topic, topic_type, qos, limits, false)
    }

    /// Creates a subscription to the bytes of `topic`, a fully qualified name. What is published from now on is queued.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: another type, a limit, a QoS that cannot be kept.
    pub fn create_raw_subscription(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawSubscription, TransportError> {
        RawSubscription::create(self, topic, topic_type, qos, limits, false)
    }

    /// As [`create_raw_publisher`](Self::create_raw_publisher), for what others published: every subscription gets it, whatever
    /// it requests.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`create_raw_publisher`](Self::create_raw_publisher).
    pub fn create_relay_publisher(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawPublisher, TransportError> {
        RawPublisher::create(self, topic, topic_type, qos, limits, true)
    }

    /// As [`create_raw_subscription`](Self::create_raw_subscription), for what is passed on: it gets what every publisher sends,
    /// whatever that offers.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`create_raw_subscription`](Self::create_raw_subscription).
    pub fn create_relay_subscription(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawSubscription, TransportError> {
        RawSubscription::create(self, topic, topic_type, qos, limits, true)
    }
}

/// An iceoryx2 node in the domain.
pub(crate) fn open_node(domain: u32) -> Result<IoxNode, TransportError> {
    set_log_level(LogLevel::Fatal);
    let refuse = |reason: String| TransportError::Node { domain, reason };
    let mut config = Config::default();
    config.global.prefix =
        FileName::new(file_prefix(domain).as_bytes()).map_err(|error| refuse(format!("{error:?}")))?;
    let root = Path::new(root_directory().as_bytes()).map_err(|error| refuse(format!("{error:?}")))?;
    config.global.set_root_path(&root);
    // Publishers that ended with samples still queued, per subscription: of more, the samples are lost and counted.
    // iceoryx2's 128 cost each subscription 460 KiB of heap.
    config.defaults.publish_subscribe.subscriber_expired_connection_buffer = 4;
    // Done by the participant and by the janitor, which tell the others.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(|error| refuse(format!("{error:?}")))
}

/// Starts the names of a domain's files in `/dev/shm`. They are private to their user, so each user has names of their own.
pub fn file_prefix(domain: u32) -> String {
    format!("taut_{domain}_{}_", rustix::process::getuid().as_raw())
}

/// Where what is not shared memory is kept: iceoryx2's descriptions of nodes and services, and the schemas.
pub(crate) fn root_directory() -> String {
    format!("/tmp/tautline_{}", rustix::process::getuid().as_raw())
}
