// SPDX-License-Identifier: MIT OR Apache-2.0
//! Events from the network, on their way to the control thread.

use crate::origin::ended_tag;
use crate::stats::GatewayState;
use crate::wire::{MAX_KEY_BYTES, TypeId};
use std::sync::atomic::Ordering;
use std::sync::{Arc, mpsc};
use tautline_relay::Event;
use zenoh::query::Query;
use zenoh::sample::{Sample, SampleKind};

pub(crate) enum NetworkEvent {
    TokenUp(String),
    TokenDown(String),
    /// A publisher of another host ended normally.
    Ended(u64),
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
