// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a subscription gets a publisher's samples: the publisher's memory, of this participant or mapped from another
//! participant's file.

use crate::error::TransportError;
use crate::memory::connection::Connection;
use crate::memory::control::{MappedControl, View};
use crate::memory::file::{ArenaOwner, PackedRange, Peer};
use crate::memory::header::Gid;
use crate::memory::pool::{SEGMENTS, SegmentView, SegmentViews};
use crate::memory::ranges::Range;
use crate::topic::writer::core::PublisherCore;
use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Weak};
use tautline_rt::PiMutex;
use tautline_rt::shm::Mapping;

#[derive(Clone)]
pub(crate) enum PublisherMemory {
    Own(Arc<PublisherCore>),
    Peer(Arc<PeerPublisher>),
}

impl PublisherMemory {
    /// The connection of a subscription, if it exists by now. A publisher of another participant must serve it, unless it has gone: an
    /// attached subscription gets what is published from then on.
    pub(crate) fn connection(
        &self,
        subscription: Gid,
        has_gone: bool,
    ) -> Result<Option<Connection>, TransportError> {
        match self {
            // Handed over to the publishing thread before the caller that attaches it releases the lock.
            PublisherMemory::Own(core) => Ok(core.view().and_then(|view| view.find(subscription).ok()?)),
            PublisherMemory::Peer(peer) => {
                let connection = peer.connection(subscription)?;
                Ok(connection.filter(|connection| has_gone || connection.block().out.is_served()))
            }
        }
    }

    /// The publisher's segments of samples, mapped, and their change count. The same views as before if nothing has changed.
    pub(crate) fn segments(&self) -> Result<(SegmentViews, u32), TransportError> {
        match self {
            PublisherMemory::Own(core) => Ok(core.segment_views()),
            PublisherMemory::Peer(peer) => peer.segments(),
        }
    }

    /// The head of the publisher's memory; `None` if that has gone.
    pub(crate) fn head(&self) -> Option<MappedControl> {
        match self {
            PublisherMemory::Own(core) => core.view().map(|view| view.head_map()),
            PublisherMemory::Peer(peer) => Some(peer.state.lock().view.head_map()),
        }
    }

    /// Where the publisher is rung.
    pub(crate) fn owner(&self) -> ArenaOwner {
        match self {
            PublisherMemory::Own(core) => ArenaOwner::Own(core.slot.doorbell().clone()),
            PublisherMemory::Peer(peer) => ArenaOwner::Peer(peer.peer.clone()),
        }
    }

    /// Whether the publisher ended in an orderly way, as own publishers always do: this process is alive.
    pub(crate) fn has_ended(&self) -> bool {
        match self {
            PublisherMemory::Own(_) => true,
            PublisherMemory::Peer(peer) => peer.state.lock().view.has_ended(),
        }
    }
}

/// A publisher of another participant, whose memory is mapped once for all subscriptions of this one.
pub(crate) struct PeerPublisher {
    peer: Arc<Peer>,
    state: PiMutex<PeerPublisherState>,
}

struct PeerPublisherState {
    view: View,
    segments: SegmentViews,
    grown: Option<u32>,
}

impl PeerPublisher {
    fn connection(&self, subscription: Gid) -> Result<Option<Connection>, TransportError> {
        let mut state = self.state.lock();
        // Each directory is twice as large as the one that it replaces, so few follow each other.
        for _ in 0..8 {
            self.map_parts(&mut state.view)?;
            if let Ok(found) = state.view.find(subscription) {
                return Ok(found);
            }
        }
        Ok(None)
    }

    fn map_parts(&self, view: &mut View) -> Result<(), TransportError> {
        for range in view.missing() {
            // A part that does not exist is a false claim, and nothing is found in it.
            if let Some(map) = self.peer.map(range, true)? {
                view.add(range, map);
            }
        }
        Ok(())
    }

    fn segments(&self) -> Result<(SegmentViews, u32), TransportError> {
        let mut state = self.state.lock();
        // Read before the segments: a change after this changes the count again.
        let grown = state.view.head().grown.load(Ordering::Acquire);
        if state.grown == Some(grown) {
            return Ok((state.segments.clone(), grown));
        }
        let mut segments: Vec<Option<SegmentView>> = state.segments.to_vec();
        segments.resize(SEGMENTS, None);
        let words = state.view.head().segments.iter();
        let told: Vec<(u64, usize)> = words
            .map(|words| {
                let place = words.place.load(Ordering::Acquire);
                (place, usize::try_from(words.sample_bytes.load(Ordering::Relaxed)).unwrap_or(0))
            })
            .collect();
        for (known, (place, sample_bytes)) in segments.iter_mut().zip(told) {
            if known.as_ref().is_some_and(|known| known.place == place && known.sample_bytes == sample_bytes)
            {
                continue;
            }
            *known = None;
            if let Some(range) = PackedRange::from_word(place).filter(|_| sample_bytes > 0)
                && let Some(map) = self.map_segment(range)?
            {
                *known = Some(SegmentView { map, sample_bytes, place });
            }
        }
        while segments.last().is_some_and(Option::is_none) {
            segments.pop();
        }
        state.segments = segments.into();
        state.grown = Some(grown);
        Ok((state.segments.clone(), grown))
    }

    fn map_segment(&self, range: Range) -> Result<Option<Arc<Mapping>>, TransportError> {
        let Some(map) = self.peer.map(range, false)? else { return Ok(None) };
        // So that a take has no page fault. If this fails, as for memory that is claimed on use, a take may have one.
        let _ = map.populate(0, map.len_bytes(), false);
        Ok(Some(map))
    }
}

/// The publishers of other participants that this participant's subscriptions use.
#[derive(Default)]
pub(crate) struct PeerPublishers {
    known: BTreeMap<Gid, Weak<PeerPublisher>>,
}

impl PeerPublishers {
    /// The memory of the publisher `gid`, which begins at `at`, as its record says. `None`: it does not exist any more.
    pub(crate) fn get(
        &mut self,
        peer: &Arc<Peer>,
        gid: Gid,
        at: u64,
    ) -> Result<Option<PublisherMemory>, TransportError> {
        if let Some(known) = self.known.get(&gid).and_then(Weak::upgrade) {
            return Ok(Some(PublisherMemory::Peer(known)));
        }
        let Some(first) = PackedRange::from_word(at) else { return Ok(None) };
        let Some(map) = peer.map(first, true)? else { return Ok(None) };
        let Some(view) = View::open(first, map, gid) else { return Ok(None) };
        let state = PiMutex::new(PeerPublisherState { view, segments: Arc::from([]), grown: None });
        let publisher = Arc::new(PeerPublisher { peer: peer.clone(), state });
        self.known.insert(gid, Arc::downgrade(&publisher));
        Ok(Some(PublisherMemory::Peer(publisher)))
    }

    /// The publishers of a participant whose segments have changed since they were mapped.
    pub(crate) fn grown(&self, participant: u64) -> Vec<Gid> {
        let of_it = self.known.range(Gid::of(participant, 0)..);
        let of_it = of_it.take_while(|(gid, _)| gid.participant() == participant);
        let has_grown = |publisher: &PeerPublisher| {
            let state = publisher.state.lock();
            state.grown.is_some_and(|grown| grown != state.view.head().grown.load(Ordering::Acquire))
        };
        let grown = of_it.filter(|(_, publisher)| publisher.upgrade().is_some_and(|one| has_grown(&one)));
        grown.map(|(gid, _)| *gid).collect()
    }

    /// Forgets the publishers that no subscription uses.
    pub(crate) fn forget(&mut self) {
        self.known.retain(|_, publisher| publisher.strong_count() > 0);
    }
}
