// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ends of a topic on other hosts, for its monitors: what a gateway says of them in its file, read by the janitor, which leaves
//! it where a monitor finds it without a system call.

use crate::doorbell::Slot;
use crate::header::Gid;
use crate::nodes::{EndpointKind, TopicEndpoint, remote_endpoints};
use crate::participant::Shared;
use crate::topic::Topic;
use std::sync::Arc;
use tautline_rt::{LatestReader, LatestWriter, latest};

/// Most ends on other hosts that a monitor tells of: what others declare costs it no more than this.
const MOST: usize = 256;

/// The ends on other hosts, as far as they are known.
pub(super) struct RemoteEnds {
    latest: LatestReader<Vec<Gid>>,
}

/// What the janitor does for a monitor.
pub(crate) struct RemoteWatch {
    topic: Arc<Topic>,
    kind: EndpointKind,
    /// The slot that is rung for the monitor's events.
    events: usize,
    known: Vec<Gid>,
    /// The graph's before `known` was read.
    epoch: u32,
    writer: LatestWriter<Vec<Gid>>,
}

impl RemoteEnds {
    /// Those of the other kind than the monitored end. Reads files.
    pub(super) fn watch(
        shared: &Shared,
        topic: &Arc<Topic>,
        kind: EndpointKind,
        events: &Slot,
    ) -> RemoteEnds {
        // Before it looks: what changes meanwhile is seen by the janitor's next look.
        let epoch = shared.graph.epoch();
        let known = of_topic(&remote_endpoints(&shared.registry), topic, kind);
        let (writer, reader) = latest(known.clone());
        let watch = RemoteWatch { topic: topic.clone(), kind, events: events.index(), known, epoch, writer };
        shared.janitor.watch_remote(watch, epoch);
        RemoteEnds { latest: reader }
    }

    /// Whether there are others than at the last look.
    pub(super) fn have_changed(&self) -> bool {
        self.latest.is_fresh()
    }

    pub(super) fn look(&mut self) -> &[Gid] {
        self.latest.read()
    }
}

impl RemoteWatch {
    /// Whether somebody looks still.
    pub(crate) fn is_wanted(&self) -> bool {
        !self.writer.is_abandoned()
    }

    /// Tells the monitor what is there now, read after the graph's `epoch`; the slot to ring if that is something else than before.
    pub(crate) fn update(&mut self, endpoints: &[TopicEndpoint], epoch: u32) -> Option<usize> {
        if self.epoch.wrapping_sub(epoch).cast_signed() > 0 {
            // Made meanwhile, from what is newer.
            return None;
        }
        self.epoch = epoch;
        let now = of_topic(endpoints, &self.topic, self.kind);
        if now == self.known {
            return None;
        }
        self.writer.write(now.clone());
        self.known = now;
        Some(self.events)
    }
}

/// Sorted, each once.
fn of_topic(endpoints: &[TopicEndpoint], topic: &Topic, kind: EndpointKind) -> Vec<Gid> {
    let hash = topic.topic_type.hash.as_deref();
    let fits = |end: &&TopicEndpoint| {
        let same_hash = || match (hash, end.topic_type.hash.as_deref()) {
            (Some(here), Some(there)) => here == there,
            // Who does not know it gets what it gets.
            _ => true,
        };
        end.kind == kind
            && end.topic == topic.name
            && end.topic_type.name == topic.topic_type.name
            && same_hash()
    };
    let mut gids: Vec<Gid> = endpoints.iter().filter(fits).map(|end| end.gid).collect();
    gids.sort_unstable();
    gids.dedup();
    gids.truncate(MOST);
    gids
}
