// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads a domain without joining it.

use crate::error::TransportError;
use crate::graph::domain::{Domain, check_domain};
use crate::graph::entities::{Death, EndpointKind, GraphSnapshot, TopicEndpoint};
use crate::graph::model::{Model, VISITOR};
use crate::memory::connection::Connection;
use crate::memory::control::{Sent, View};
use crate::memory::file::Peer;
use crate::memory::header::Gid;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// Reads a domain of this user, host and scope without joining it: for tools. It changes nothing there, and costs other processes
/// nothing.
///
/// ```
/// let mut visitor = tautline_transport::Visitor::new(121)?;
/// assert!(visitor.graph()?.nodes.is_empty());
/// # Ok::<(), tautline_transport::TransportError>(())
/// ```
pub struct Visitor {
    number: u32,
    /// `None`: the domain does not exist yet.
    domain: Option<Arc<Domain>>,
    model: Model,
    /// When it was last checked which processes are alive.
    looked: Instant,
    /// The memory of publishers that [`sent`](Self::sent) or [`overwritten`](Self::overwritten) was called for.
    views: HashMap<Gid, View>,
}

impl Visitor {
    /// A visitor of the domain with this number, which need not exist yet.
    ///
    /// # Real-time
    /// Not for real-time threads, like all functions of this type: maps files, allocates.
    ///
    /// # Errors
    /// A number that is not a domain, or an invalid `TAUT_SCOPE`.
    pub fn new(domain: u32) -> Result<Self, TransportError> {
        check_domain(domain)?;
        let (model, views) = (Model::new(VISITOR), HashMap::new());
        Ok(Visitor { number: domain, domain: None, model, looked: Instant::now(), views })
    }

    /// Everything that exists in the domain now. If nothing has changed since the last call, returns the same snapshot after
    /// one check.
    ///
    /// # Errors
    /// As [`Participant::graph`](crate::Participant::graph).
    pub fn graph(&mut self) -> Result<Arc<GraphSnapshot>, TransportError> {
        if self.domain.is_none() {
            self.domain = Domain::visit(self.number)?;
        }
        let Some(domain) = &self.domain else { return Ok(Arc::default()) };
        if self.looked.elapsed() >= LIFE {
            self.looked = Instant::now();
            self.model.forget_dead(domain);
        }
        let graph = self.model.refresh(domain)?;
        self.views.retain(|gid, _| self.model.memory_of(*gid).is_some());
        Ok(graph)
    }

    /// The processes of the [`graph`](Self::graph) that have died since the last call: at most 4,096.
    pub fn take_deaths(&mut self) -> Vec<Death> {
        std::mem::take(&mut self.model.deaths)
    }

    /// Why live participants are left out of the [`graph`](Self::graph): their files are of another version of Tautline, or
    /// damaged.
    pub fn left_out(&self) -> Vec<TransportError> {
        let Some(domain) = &self.domain else { return Vec::new() };
        let number = domain.number();
        let living = domain.members().filter(|member| Peer::is_alive(number, member.id));
        living.filter_map(|member| Peer::open(number, member.id).err()).collect()
    }

    /// What a publisher of this host has sent, by its own count. `None`: it has ended, or is on another host.
    /// Call [`graph`](Self::graph) first.
    ///
    /// # Errors
    /// The system refuses to map its memory.
    pub fn sent(&mut self, publisher: &TopicEndpoint) -> Result<Option<Sent>, TransportError> {
        Ok(self.view(publisher)?.map(|view| view.head_map().sent()))
    }

    /// How many messages of a publisher of this host were overwritten by newer ones before they were taken: for each subscription
    /// that it is connected to now, observers included, since the connection was made. Empty where [`sent`](Self::sent) is `None`.
    ///
    /// # Errors
    /// As [`sent`](Self::sent).
    pub fn overwritten(&mut self, publisher: &TopicEndpoint) -> Result<Vec<(Gid, u64)>, TransportError> {
        let gid = publisher.gid;
        let Some(view) = self.view(publisher)? else { return Ok(Vec::new()) };
        let missing = view.missing();
        let Some((peer, _)) = self.model.memory_of(gid) else { return Ok(Vec::new()) };
        let maps = missing.into_iter().map(|range| Ok((range, peer.map(range, false)?)));
        let maps = maps.collect::<Result<Vec<_>, TransportError>>()?;
        let Some(view) = self.views.get_mut(&gid) else { return Ok(Vec::new()) };
        for (range, map) in maps {
            // A publisher that has ended meanwhile has no connections.
            let Some(map) = map else { return Ok(Vec::new()) };
            view.add(range, map);
        }
        let count = |connection: &Connection| {
            let subscription = connection.subscription();
            let count = connection.block().out.overwritten.load(Ordering::Acquire);
            // The place may be in use for another subscription by now.
            (connection.subscription() == subscription).then_some((subscription, count))
        };
        Ok(view.connections().iter().filter_map(count).collect())
    }

    fn view(&mut self, publisher: &TopicEndpoint) -> Result<Option<&View>, TransportError> {
        if publisher.is_remote || publisher.kind != EndpointKind::Publisher {
            return Ok(None);
        }
        match self.views.entry(publisher.gid) {
            Entry::Occupied(view) => Ok(Some(view.into_mut())),
            Entry::Vacant(place) => {
                let Some((peer, first)) = self.model.memory_of(publisher.gid) else { return Ok(None) };
                let Some(map) = peer.map(first, false)? else { return Ok(None) };
                Ok(View::open(first, map, publisher.gid).map(|view| &*place.insert(view)))
            }
        }
    }
}

/// Interval of checks which processes have died.
const LIFE: Duration = Duration::from_millis(500);

/// What exists in a domain now: see [`Visitor::graph`].
///
/// ```
/// let graph = tautline_transport::graph_of(121)?;
/// assert!(graph.nodes.is_empty() && graph.endpoints.is_empty());
/// # Ok::<(), tautline_transport::TransportError>(())
/// ```
///
/// # Real-time
/// Not for real-time threads: maps files, allocates.
///
/// # Errors
/// Those of [`Visitor`].
pub fn graph_of(domain: u32) -> Result<Arc<GraphSnapshot>, TransportError> {
    Visitor::new(domain)?.graph()
}

tautline_rt::debug_fields!(Visitor, |this| domain = this.number);
