// SPDX-License-Identifier: MIT OR Apache-2.0
//! Transient local: what a late joiner missed.
//!
//! iceoryx2 hands its history out when the publisher next sends, so a silent publisher's late joiners would wait for
//! ever, and calling it from another thread would need a lock that `publish` takes too. So each transient-local
//! publisher has a *keeper*, an additional subscriber whose queue of `depth` holds the last samples at no cost. It
//! belongs to the janitor, which copies them to a late joiner over a second service, ending with a mark. `publish`
//! knows nothing of this. The late joiner takes the history first and drops what it then gets twice.

use crate::address::{Address, Role};
use crate::doorbell::Doorbell;
use crate::error::TransportError;
use crate::header::{END_OF_HISTORY, Gid, SampleHeader};
use crate::lending::{Shelf, Sole};
use crate::ports::{self, Reached};
use crate::qos::Qos;
use crate::topic::{IoxPublisher, IoxSample, IoxSubscriber, Topic, Word};
use std::collections::VecDeque;
use std::sync::Arc;
use tautline_rt::clock::monotonic_ns;

/// How long a late joiner waits for the histories of the publishers it found, before it takes what is live.
const PATIENCE_NS: u64 = 1_000_000_000;

/// Keeps one publisher's last samples. Owned by the janitor.
pub(crate) struct Keeper {
    domain: u32,
    doorbell: Arc<Doorbell>,
    topic: Arc<Topic>,
    gid: Gid,
    depth: usize,
    queue: Sole<IoxSubscriber>,
    /// What was taken from the queue when an earlier late joiner came.
    kept: VecDeque<(SampleHeader, Vec<Word>)>,
    outlet: Option<Sole<IoxPublisher>>,
    served: Vec<u128>,
}

impl Keeper {
    pub(crate) fn new(
        domain: u32,
        doorbell: &Arc<Doorbell>,
        topic: &Arc<Topic>,
        gid: Gid,
        depth: usize,
        slot: usize,
    ) -> Result<Self, TransportError> {
        let (arena, qos) = (doorbell.arena().id(), Qos::keep_last(depth));
        let address = Address { role: Role::Keeper, arena, slot, qos, is_relay: false };
        let queue = topic
            .factory
            .subscriber_builder()
            .name(&address.to_port_name())
            .buffer_size(depth)
            .create()
            .map_err(|error| topic.iceoryx_error("keeping samples for late joiners", error))?;
        Ok(Keeper {
            domain,
            doorbell: doorbell.clone(),
            topic: topic.clone(),
            gid,
            depth,
            queue: Sole::new(queue),
            kept: VecDeque::new(),
            outlet: None,
            served: Vec::new(),
        })
    }

    /// Gives each late joiner that was not served yet the last `depth` samples and the mark that ends them.
    pub(crate) fn serve(&mut self) {
        let Some(history) = &self.topic.history else { return };
        let joiners = ports::subscriptions(history);
        self.served.retain(|id| joiners.iter().any(|joiner| joiner.id == *id));
        if joiners.iter().all(|joiner| self.served.contains(&joiner.id)) {
            return;
        }
        self.keep_what_is_queued();
        if let Err(error) = self.send_kept() {
            tracing::warn!("topic '{}': a late joiner misses the history: {error}", self.topic.name);
        }
        for joiner in joiners {
            if let Some(reached) = Reached::reach(self.domain, &self.doorbell, joiner.address.arena) {
                reached.arena().bell().ring(joiner.address.slot);
            }
            self.served.push(joiner.id);
        }
    }

    fn keep_what_is_queued(&mut self) {
        while let Ok(Some(sample)) = self.queue.get().receive() {
            if sample.user_header().gid != self.gid {
                continue;
            }
            if self.kept.len() == self.depth {
                self.kept.pop_front();
            }
            self.kept.push_back((*sample.user_header(), sample.payload().to_vec()));
        }
    }

    fn send_kept(&mut self) -> Result<(), TransportError> {
        let topic = self.topic.clone();
        let Some(history) = &topic.history else { return Ok(()) };
        if self.outlet.is_none() {
            let outlet = topic
                .history_port(history)
                .map_err(|error| topic.iceoryx_error("serving late joiners", error))?;
            self.outlet = Some(Sole::new(outlet));
        }
        let Some(outlet) = self.outlet.as_ref().map(Sole::get) else { return Ok(()) };
        let end = SampleHeader { gid: self.gid, expires_ns: END_OF_HISTORY, ..SampleHeader::default() };
        for (header, body) in
            self.kept.iter().map(|(header, body)| (*header, body.as_slice())).chain([(end, &[][..])])
        {
            let mut loan = outlet
                .loan_slice_uninit(body.len())
                .map_err(|error| topic.iceoryx_error("serving late joiners", error))?
                .write_from_slice(body);
            // It appears for its late joiner now: a response time counts from here.
            *loan.user_header_mut() = SampleHeader { released_ns: monotonic_ns(), ..header };
            loan.send().map_err(|error| topic.iceoryx_error("serving late joiners", error))?;
        }
        Ok(())
    }
}

/// A late joiner's side: open until every publisher that it found has ended its history, or patience runs out.
pub(crate) struct Catch {
    // Dropped in this order.
    pub(crate) inlet: Sole<IoxSubscriber>,
    pub(crate) shelf: Shelf<IoxSample>,
    awaited: Vec<Gid>,
    give_up_ns: u64,
}

impl Catch {
    /// `None` if there is no transient-local publisher whose history could be missing.
    pub(crate) fn open(
        topic: &Topic,
        address: Address,
        depth: usize,
    ) -> Result<Option<Self>, TransportError> {
        let awaited: Vec<Gid> = ports::publishers(topic)
            .into_iter()
            .filter(|port| port.address.role == Role::TransientPublisher)
            .map(|port| port.gid)
            .collect();
        let Some(history) = topic.history.as_ref().filter(|_| !awaited.is_empty()) else { return Ok(None) };
        let inlet = history
            .subscriber_builder()
            .name(&address.to_port_name())
            .buffer_size(depth + 1)
            .create()
            .map_err(|error| topic.iceoryx_error("asking for the history", error))?;
        let (inlet, shelf) = (Sole::new(inlet), Shelf::new(topic.limits.held));
        Ok(Some(Catch { inlet, shelf, awaited, give_up_ns: monotonic_ns() + PATIENCE_NS }))
    }

    /// The mark of `gid` came.
    pub(crate) fn end(&mut self, gid: Gid) {
        self.awaited.retain(|awaited| *awaited != gid);
    }

    pub(crate) fn give_up_ns(&self) -> u64 {
        self.give_up_ns
    }

    pub(crate) fn is_complete(&self) -> bool {
        self.awaited.is_empty() || monotonic_ns() >= self.give_up_ns
    }
}
