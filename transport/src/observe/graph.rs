// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a participant reads its domain: the whole graph, parts of it, and changes.

use crate::error::TransportError;
use crate::graph::entities::{EndpointKind, GraphSnapshot, NodeName, ServiceEndpoint, TopicEndpoint};
use crate::graph::events::GraphEvents;
use crate::graph::log::hash_of;
use crate::graph::topic_type::TopicType;
use crate::topic::participant::Participant;
use std::sync::Arc;
use std::time::Duration;

/// A topic of a domain.
#[derive(Clone, Debug)]
pub struct TopicInfo {
    /// The fully qualified name.
    pub name: String,
    /// Its publishers.
    pub publishers: Vec<Arc<TopicEndpoint>>,
    /// Its subscriptions.
    pub subscriptions: Vec<Arc<TopicEndpoint>>,
}

impl Participant {
    /// Everything that exists in the domain. If nothing has changed since the last call, returns the same snapshot after
    /// one check.
    ///
    /// # Real-time
    /// Not for real-time threads: waits for a lock, maps files, allocates.
    ///
    /// # Errors
    /// [`TransportError`]: the system refuses to map another participant's record, for example at the limit of open files. A record that
    /// is damaged or of another version is skipped, and logged once.
    pub fn graph(&self) -> Result<Arc<GraphSnapshot>, TransportError> {
        self.check_process()?;
        self.state.graph()
    }

    /// How many nodes of the domain have this name. Cheaper than [`graph`](Self::graph), which takes time and memory in proportion
    /// to the size of the whole graph.
    ///
    /// # Real-time
    /// As [`graph`](Self::graph).
    pub fn node_count(&self, name: &NodeName) -> usize {
        self.state.matcher.nodes(hash_of(&name.full_name()))
    }

    /// The topics of the domain, sorted by name, without the topics that services consist of.
    ///
    /// # Real-time and errors
    /// As [`graph`](Self::graph).
    pub fn topics(&self) -> Result<Vec<TopicInfo>, TransportError> {
        let graph = self.graph()?;
        let mut topics: Vec<TopicInfo> = Vec::new();
        for end in &graph.endpoints {
            if topics.last().is_none_or(|topic| topic.name != end.topic) {
                let (publishers, subscriptions) = Default::default();
                topics.push(TopicInfo { name: end.topic.clone(), publishers, subscriptions });
            }
            if let Some(topic) = topics.last_mut() {
                match end.kind {
                    EndpointKind::Publisher => topic.publishers.push(end.clone()),
                    EndpointKind::Subscription => topic.subscriptions.push(end.clone()),
                }
            }
        }
        Ok(topics)
    }

    /// The type of a topic: see [`GraphSnapshot::topic_type`].
    ///
    /// # Real-time and errors
    /// As [`graph`](Self::graph).
    pub fn topic_type(&self, topic: &str) -> Result<Option<TopicType>, TransportError> {
        Ok(self.graph()?.topic_type(topic))
    }

    /// The type of a service, as far as its servers and clients know it; `None` if it has none of these, or if they
    /// disagree.
    ///
    /// # Real-time and errors
    /// As [`graph`](Self::graph).
    pub fn service_type(&self, service: &str) -> Result<Option<TopicType>, TransportError> {
        let graph = self.graph()?;
        let of = |end: &Arc<ServiceEndpoint>| TopicType {
            hash: end.type_hash.clone().map(Into::into),
            ..TopicType::new(end.type_name.clone())
        };
        let mut types = graph.services.iter().filter(|end| end.name == service).map(of);
        let Some(first) = types.next() else { return Ok(None) };
        Ok(types.try_fold(first, |known, other| known.join(&other)))
    }

    /// A number that changes when a node, publisher, subscription, service or client of the domain appears or disappears.
    /// Read it before [`graph`](Self::graph): while it is unchanged, so is the graph.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn graph_epoch(&self) -> u32 {
        self.state.domain.epoch()
    }

    /// Sleeps until [`graph_epoch`](Self::graph_epoch) differs from `since`, at most for `timeout`. Returns the
    /// epoch.
    ///
    /// # Real-time
    /// Waits.
    pub fn wait_for_graph_change(&self, since: u32, timeout: Duration) -> u32 {
        self.state.domain.wait(since, Some(timeout))
    }

    /// Wakes a task when something in the domain appears or disappears, and when an endpoint of this participant is connected or
    /// disconnected. All changes between two polls are one event.
    ///
    /// # Real-time
    /// Setup only: the first call starts an ordinary thread of low priority, which sleeps until something changes.
    ///
    /// # Errors
    /// [`TransportError::Thread`] if the thread cannot be started.
    pub fn graph_events(&self) -> Result<GraphEvents, TransportError> {
        self.state.graph_events()
    }
}
