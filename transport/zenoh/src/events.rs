// SPDX-License-Identifier: MIT OR Apache-2.0
//! Events from the network, on their way to the control thread.

use crate::origin::ended_tag;
use crate::stats::GatewayState;
use crate::wire::{MAX_KEY_BYTES, TypeId};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tautline_relay::Event;
use zenoh::query::Query;
use zenoh::sample::{Sample, SampleKind};

pub(crate) enum NetworkEvent {
    TokenUp(String),
    TokenDown(String),
    /// A publisher of another host ended normally.
    Ended(u64),
    /// All tokens are to be requested again: see [`Resyncs`].
    Resync,
    /// A remote node responded with the description of this type; `None` if the response is too long.
    Described(TypeId, Option<Vec<u8>>),
    /// A remote node requests a type description from a local node.
    Asked(Query),
}

/// The queue of events to the control thread.
pub(crate) type Events = mpsc::SyncSender<Event<NetworkEvent>>;

/// Passes tokens from Zenoh's thread to the control thread. On overflow, all tokens are requested again later.
pub(crate) fn tokens_to(events: Events, state: Arc<GatewayState>) -> impl Fn(Sample) + Send + Sync + 'static {
    move |sample| {
        let key = cut(sample.key_expr().as_str());
        let event = match sample.kind() {
            SampleKind::Put => NetworkEvent::TokenUp(key),
            SampleKind::Delete => NetworkEvent::TokenDown(key),
        };
        if events.try_send(Event::FarChange(event)).is_err() {
            state.has_missed.store(true, Ordering::Relaxed);
        }
    }
}

/// The first and the longest pause before a resync that was not answered in time is repeated.
const RETRY_PAUSE: Duration = Duration::from_secs(4);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// When all tokens are requested again.
#[derive(Default)]
pub(crate) struct Resyncs {
    is_queued: bool,
    /// When a resync is repeated that was not answered whole, and the pause before.
    retry: Option<(Instant, Duration)>,
}

impl Resyncs {
    /// Queues a resync that is due, because events were dropped or the last resync was late: behind the events that came before, which
    /// would undo what it finds.
    pub(crate) fn queue_if_due(&mut self, events: &Events, has_missed: &AtomicBool) {
        // A queued one comes before the events that were dropped since: they need another one.
        if self.is_queued {
            return;
        }
        let is_due = has_missed.swap(false, Ordering::Relaxed)
            || self.retry.is_some_and(|(at, _)| Instant::now() >= at);
        if is_due {
            self.is_queued = events.try_send(Event::FarChange(NetworkEvent::Resync)).is_ok();
            has_missed.fetch_or(!self.is_queued, Ordering::Relaxed);
        }
    }

    /// Notes that the queued resync was done. One that `is_late` is repeated.
    pub(crate) fn done(&mut self, is_late: bool) {
        self.is_queued = false;
        let pause = self.retry.map_or(RETRY_PAUSE, |(_, pause)| (2 * pause).min(LONGEST_PAUSE));
        self.retry = is_late.then(|| (Instant::now() + pause, pause));
    }
}

/// Passes announcements of publishers' normal ends to the control thread, except those of this session.
pub(crate) fn ends_to(events: Events, own_zid: u128) -> impl Fn(Sample) + Send + Sync + 'static {
    move |sample| {
        let said = ended_tag(sample.key_expr().as_str()).filter(|_| sample.kind() == SampleKind::Put);
        if let Some((_, tag)) = said.filter(|(zid, _)| *zid != own_zid) {
            // On overflow the end counts as a death.
            let _ = events.try_send(Event::FarChange(NetworkEvent::Ended(tag)));
        }
    }
}

/// Truncates an overlong key to more than the limit: it is then refused, and not stored in full.
pub(crate) fn cut(key: &str) -> String {
    let mut end = key.len().min(MAX_KEY_BYTES + 1);
    while !key.is_char_boundary(end) {
        end += 1;
    }
    key[..end].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A token comes, and its end finds no room: a resync before the queued event would leave the token in the graph for ever.
    #[test]
    fn a_resync_comes_after_the_events_from_before() {
        let (events, received) = mpsc::sync_channel(2);
        let (mut resyncs, has_missed) = (Resyncs::default(), AtomicBool::new(true));
        let text = |event| match event {
            Event::FarChange(NetworkEvent::TokenUp(key)) => key,
            Event::FarChange(NetworkEvent::Resync) => "resync".to_owned(),
            _ => panic!("nothing else was sent"),
        };
        let comes = |key: &str| events.try_send(Event::FarChange(NetworkEvent::TokenUp(key.into()))).is_ok();
        let is_missed = || has_missed.load(Ordering::Relaxed);
        assert!(comes("a") && comes("b") && !comes("c"));
        resyncs.queue_if_due(&events, &has_missed);
        assert!(is_missed(), "no room yet");
        assert_eq!(received.try_recv().map(text).as_deref(), Ok("a"));
        resyncs.queue_if_due(&events, &has_missed);
        assert!(!is_missed());
        // Dropped after the resync was queued.
        has_missed.store(true, Ordering::Relaxed);
        resyncs.queue_if_due(&events, &has_missed);
        assert_eq!(received.try_iter().map(text).collect::<Vec<_>>(), ["b", "resync"]);
        resyncs.done(false);
        resyncs.queue_if_due(&events, &has_missed);
        assert_eq!(received.try_iter().map(text).collect::<Vec<_>>(), ["resync"]);
        // A late one is repeated, though no event was dropped, when its pause is over.
        resyncs.done(true);
        resyncs.retry = resyncs.retry.map(|(at, pause)| (at - pause, pause));
        resyncs.queue_if_due(&events, &has_missed);
        assert_eq!(received.try_iter().map(text).collect::<Vec<_>>(), ["resync"]);
        resyncs.done(true);
        assert_eq!(resyncs.retry.map(|(_, pause)| pause), Some(2 * RETRY_PAUSE));
    }
}
