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
use futures::channel::oneshot;
use std::collections::VecDeque;
use std::sync::Arc;
use tautline_rt::clock::monotonic_ns;

/// How long a late joiner waits for the histories of the publishers it found, before it takes what is live.
const PATIENCE_NS: u64 = 1_000_000_000;

/// A keeper's queue holds the samples of all of the topic's publishers, and iceoryx2 empties that of one after the other. So often
/// they may be full until it has come to the one that it is for: once as it finds them, once more while it empties them.
const ROUNDS: usize = 2;

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

    /// Gives each late joiner that was not served yet the last `depth` samples and the mark that ends them. Calls `between` before
    /// each sample that is copied: that can take long, and the janitor has more to do.
    ///
    /// # Real-time
    /// For a low-priority thread. Bounded, however fast the publishers are: copies at most `depth` samples twice, and looks at
    /// 2 x `depth` x publishers.
    pub(crate) fn serve(&mut self, between: &mut dyn FnMut()) {
        let Some(history) = &self.topic.history else { return };
        let joiners = ports::subscriptions(history);
        self.served.retain(|id| joiners.iter().any(|joiner| joiner.id == *id));
        if joiners.iter().all(|joiner| self.served.contains(&joiner.id)) {
            return;
        }
        if !self.keep_what_is_queued(between) {
            // Other publishers were too fast: at the next look, while the joiners' patience lasts.
            return;
        }
        if let Err(error) = self.send_kept(between) {
            tracing::warn!("topic '{}': a late joiner misses the history: {error}", self.topic.name);
        }
        for joiner in joiners {
            // If not, it takes the history when its patience is over.
            if let Some(reached) = Reached::reach_at_best(self.domain, &self.doorbell, joiner.address.arena) {
                reached.arena().bell().ring(joiner.address.slot);
            }
            if !self.served.contains(&joiner.id) {
                self.served.push(joiner.id);
            }
        }
    }

    /// False if it may not have come to what was queued when it began. What is published later goes to the late joiners themselves.
    fn keep_what_is_queued(&mut self, between: &mut dyn FnMut()) -> bool {
        let mut own = 0;
        for _ in 0..ROUNDS * self.depth * self.topic.limits.publishers {
            let Ok(Some(sample)) = self.queue.get().receive() else { return true };
            if sample.user_header().gid != self.gid {
                continue;
            }
            between();
            if self.kept.len() == self.depth {
                self.kept.pop_front();
            }
            self.kept.push_back((*sample.user_header(), sample.payload().to_vec()));
            own += 1;
            // There were no more.
            if own == self.depth {
                return true;
            }
        }
        false
    }

    fn send_kept(&mut self, between: &mut dyn FnMut()) -> Result<(), TransportError> {
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
            between();
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
    /// The janitor's [`Finished`], where it goes when it is complete.
    janitor: Option<oneshot::Sender<Catch>>,
}

/// Where a late joiner's side is closed: that unmaps memory and removes files, which the thread that takes is spared.
pub(crate) struct Finished {
    come: oneshot::Receiver<Catch>,
    catch: Option<Catch>,
}

impl Finished {
    /// Closes it if it has come and none of its samples is out. False if that is still to be.
    pub(crate) fn close(&mut self) -> bool {
        if self.catch.is_none() {
            match self.come.try_recv() {
                Ok(None) => return false,
                Ok(catch) => self.catch = catch,
                // It was dropped before it was complete.
                Err(oneshot::Canceled) => return true,
            }
        }
        if self.catch.as_ref().is_some_and(|catch| !catch.shelf.is_whole()) {
            return false;
        }
        self.catch = None;
        true
    }
}

impl Catch {
    /// `None` if there is no transient-local publisher whose history could be missing.
    pub(crate) fn open(
        topic: &Topic,
        address: Address,
        depth: usize,
    ) -> Result<Option<(Self, Finished)>, TransportError> {
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
        let (janitor, come) = oneshot::channel();
        let (janitor, give_up_ns) = (Some(janitor), monotonic_ns() + PATIENCE_NS);
        let catch = Catch { inlet, shelf, awaited, give_up_ns, janitor };
        Ok(Some((catch, Finished { come, catch: None })))
    }

    /// It is complete: the janitor closes it.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn finish(mut self) {
        if let Some(janitor) = self.janitor.take() {
            // If nobody is there any more, it is closed here.
            let _ = janitor.send(self);
        }
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

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::{Limits, Participant, TopicType};

    #[test]
    fn a_late_joiner_is_served_with_pauses_and_closed_by_the_janitor_when_its_samples_are_back() {
        let participant = Participant::new(99).unwrap();
        let (text, qos) = (TopicType::new("test_msgs/msg/Text"), Qos::keep_last(3).transient_local());
        let publisher = participant.create_raw_publisher("/kept", &text, qos, Limits::default()).unwrap();
        let (topic, slot, address) = publisher.place();
        let doorbell = participant.doorbell();
        // Besides the janitor's.
        let mut keeper = Keeper::new(99, doorbell, topic, publisher.gid(), 3, slot.index()).unwrap();
        (0..5).for_each(|n| publisher.publish(&[n; 8]).unwrap());
        let joiner = Address { role: Role::Subscription, ..address };
        let (catch, mut finished) = Catch::open(topic, joiner, 3).unwrap().unwrap();
        let mut pauses = 0;
        keeper.serve(&mut || pauses += 1);
        assert_eq!(pauses, 3 + 4, "three taken; three sent, and the mark");

        let ports = || ports::subscriptions(topic.history.as_ref().unwrap()).len();
        let sample = catch.inlet.get().receive().unwrap().unwrap();
        let lent = catch.shelf.lend(sample).unwrap();
        assert!(!finished.close(), "the joiner uses it");
        catch.finish();
        assert!(!finished.close() && ports() == 1, "a sample is out");
        drop(lent);
        assert!(finished.close() && ports() == 0);
    }
}
