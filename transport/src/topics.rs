// SPDX-License-Identifier: MIT OR Apache-2.0
//! Listing the topics of a domain with their publishers and subscriptions: for tools, the gateway and bridges.

use crate::address::{Address, Role};
use crate::dead_nodes;
use crate::doorbell::ArenaId;
use crate::error::TransportError;
use crate::header::Gid;
use crate::nodes::remote_topic_type;
use crate::participant::Participant;
use crate::ports;
use crate::qos::Qos;
use crate::topic::{Factory, HISTORY, open_existing};
use crate::topic_type::TopicType;
use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::*;
use iceoryx2::service::static_config::messaging_pattern::MessagingPattern;
use std::time::Duration;

/// Start the names of the topics that make services. ':' cannot be in a topic's name.
pub(crate) const REQUESTS: &str = "request:";
pub(crate) const RESPONSES: &str = "response:";

/// A topic of a domain.
#[derive(Clone, Debug)]
pub struct TopicInfo {
    /// The fully qualified name.
    pub name: String,
    /// What is known of its type: what whoever made the topic knew.
    pub topic_type: TopicType,
    /// Its publishers.
    pub publishers: Vec<EndpointInfo>,
    /// Its subscriptions.
    pub subscriptions: Vec<EndpointInfo>,
}

/// A publisher or a subscription of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EndpointInfo {
    /// Its identifier.
    pub gid: Gid,
    /// The quality of service that was asked for.
    pub qos: Qos,
    /// The process it lives in.
    pub pid: Option<u32>,
    /// Whether it belongs to the participant that made the list.
    pub is_own: bool,
    /// Of its participant.
    pub(crate) arena: ArenaId,
}

impl Participant {
    /// The topics of the domain, sorted by name, without those that make [services](Self::services). What processes that were
    /// killed left is removed before.
    ///
    /// # Real-time
    /// Not for real-time threads: opens each topic, with files and allocations.
    ///
    /// # Errors
    /// [`TransportError::Node`] if the list cannot be read.
    pub fn topics(&self) -> Result<Vec<TopicInfo>, TransportError> {
        self.list_topics(|name| ![HISTORY, REQUESTS, RESPONSES].iter().any(|hidden| name.starts_with(hidden)))
    }

    pub(crate) fn list_topics(
        &self,
        is_listed: impl Fn(&str) -> bool,
    ) -> Result<Vec<TopicInfo>, TransportError> {
        let node = &self.shared.node;
        // Opening a topic removes its dead ports too, but without a word to those who wait for changes.
        dead_nodes::remove(node, &self.shared.graph);
        let mut names = Vec::new();
        ipc::Service::list(node.config(), |details| {
            let config = &details.static_details;
            let name = config.name().as_str();
            if matches!(config.messaging_pattern(), MessagingPattern::PublishSubscribe(_))
                && is_listed(name)
                && let Some(topic_type) = TopicType::from_attributes(config.attributes())
            {
                names.push((name.to_owned(), topic_type));
            }
            CallbackProgression::Continue
        })
        .map_err(|error| TransportError::Node {
            domain: self.domain(),
            reason: format!("its topics cannot be listed: {error:?}"),
        })?;
        names.sort_by(|one, other| one.0.cmp(&other.0));
        Ok(names
            .into_iter()
            .filter_map(|(name, topic_type)| {
                // Gone meanwhile, if it cannot be opened.
                let factory = open_existing(node, &name)?;
                let (publishers, subscriptions) = self.endpoints(&factory);
                Some(TopicInfo { name, topic_type, publishers, subscriptions })
            })
            .collect())
    }

    fn endpoints(&self, factory: &Factory) -> (Vec<EndpointInfo>, Vec<EndpointInfo>) {
        let own = self.shared.doorbell.arena().id();
        let endpoint = |id: u128, name: &str, node: &UniqueNodeId| {
            let Address { role, arena, qos, .. } = Address::parse(name)?;
            let pid = node.pid::<ipc::Service>().ok().and_then(|pid| u32::try_from(pid.value()).ok());
            Some((role, EndpointInfo { gid: ports::gid(id), qos, pid, is_own: arena == own, arena }))
        };
        let (mut publishers, mut subscriptions) = (Vec::new(), Vec::new());
        factory.dynamic_config().list_publishers(|details| {
            let (id, name) = (details.publisher_id.value(), details.publisher_name.as_str());
            publishers.extend(endpoint(id, name, &details.node_id).map(|(_, info)| info));
            CallbackProgression::Continue
        });
        factory.dynamic_config().list_subscribers(|details| {
            let (id, name) = (details.subscriber_id.value(), details.subscriber_name.as_str());
            let found = endpoint(id, name, &details.node_id);
            // A keeper is a part of its publisher.
            subscriptions.extend(found.filter(|(role, _)| *role == Role::Subscription).map(|(_, info)| info));
            CallbackProgression::Continue
        });
        (publishers, subscriptions)
    }

    /// The type of a topic, as far as whoever made it knew it, on this host or else on another; `None` if there is no such
    /// topic.
    ///
    /// # Real-time
    /// Not for real-time threads: opens the topic, with files and allocations.
    pub fn topic_type(&self, topic: &str) -> Option<TopicType> {
        let factory = open_existing(&self.shared.node, topic);
        let here = factory.and_then(|factory| TopicType::from_attributes(factory.attributes()));
        here.or_else(|| remote_topic_type(&self.shared.registry, topic))
    }

    /// A number that changes when a node, publisher, subscription, service or client of the domain appears or goes. Read it
    /// before [`graph`](Self::graph) or [`topics`](Self::topics): if it is the same later, so is the list.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn graph_epoch(&self) -> u32 {
        self.shared.graph.epoch()
    }

    /// Sleeps until [`graph_epoch`](Self::graph_epoch) is not `since`, at most for `timeout`. Returns the epoch.
    ///
    /// # Real-time
    /// Waits.
    pub fn wait_for_graph_change(&self, since: u32, timeout: Duration) -> u32 {
        self.shared.graph.wait(since, timeout)
    }
}
