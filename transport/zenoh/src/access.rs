// SPDX-License-Identifier: MIT OR Apache-2.0
//! Counts refusals by Zenoh's access control, which only its trace events report.

use crate::origin::ENDED;
use crate::wire::TopicKey;
use std::collections::BTreeMap;
use std::fmt::{Debug, Write};
use std::sync::{Mutex, PoisonError};
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::filter_fn;
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

const TARGET: &str = "zenoh::net::routing::interceptor::access_control";
/// Maximum of distinct refusals; a hostile peer may try any key.
const MAX_REFUSALS: usize = 256;
/// Longest event to parse: a key and an address.
const MAX_EVENT_BYTES: usize = 4096;

static REFUSED: Mutex<BTreeMap<String, u64>> = Mutex::new(BTreeMap::new());

/// A layer for the process's `tracing` subscriber; without the layer [`Stats::unauthorized`](crate::Stats::unauthorized) stays empty.
/// It enables the events of Zenoh's access control for itself only.
///
/// ```
/// use tracing_subscriber::layer::SubscriberExt;
/// use tracing_subscriber::util::SubscriberInitExt;
///
/// tracing_subscriber::registry().with(tautline_gateway::access_layer()).init();
/// ```
pub fn access_layer<S: Subscriber + for<'span> LookupSpan<'span>>() -> impl Layer<S> {
    Refusals.with_filter(filter_fn(|event| event.target() == TARGET))
}

/// Refusals in this process, such as `Put (ingress) on /secret`, with their counts.
pub(crate) fn refused() -> BTreeMap<String, u64> {
    REFUSED.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

struct Refusals;

impl<S: Subscriber> Layer<S> for Refusals {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut text = Text::default();
        event.record(&mut text);
        if let Some(refusal) = refusal(&text.0) {
            let mut refused = REFUSED.lock().unwrap_or_else(PoisonError::into_inner);
            let is_known = refused.contains_key(&refusal) || refused.len() < MAX_REFUSALS;
            *refused.entry(if is_known { refusal } else { "others".to_owned() }).or_default() += 1;
        }
    }
}

/// The text of an event, truncated at the limit.
#[derive(Default)]
struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            let _ = write!(self, "{value:?}");
        }
    }
}

impl Write for Text {
    fn write_str(&mut self, part: &str) -> std::fmt::Result {
        if self.0.len() + part.len() > MAX_EVENT_BYTES {
            return Err(std::fmt::Error);
        }
        self.0.push_str(part);
        Ok(())
    }
}

/// The action, and the topic or key, of `[..] is unauthorized to Put (ingress) on 0/secret/type/hash`; `None` for other events.
fn refusal(event: &str) -> Option<String> {
    let (_, refused) = event.split_once(" is unauthorized to ")?;
    let (action, key) = refused.split_once(" on ")?;
    // A peer that may not see a node does not see its tokens either: counting the refusals of the topic itself suffices.
    if key.contains("@ros2_lv/") || key.contains(ENDED) {
        return None;
    }
    let base = key.strip_suffix("/_buf_cpu").unwrap_or(key);
    let topic = TopicKey::parse(base).map_or_else(|_| key.to_owned(), |key| key.topic);
    Some(format!("{action} on {topic}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_told_from_permissions() {
        let key = "0/secret/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
        let cached = format!("Using cached result: ab12 is unauthorized to Put (ingress) on {key}");
        assert_eq!(refusal(&cached).as_deref(), Some("Put (ingress) on /secret"));
        let first = "ab12 on second is unauthorized to Query (egress) on some/other/key";
        assert_eq!(refusal(first).as_deref(), Some("Query (egress) on some/other/key"));
        assert_eq!(refusal(&cached.replace("unauthorized", "authorized")), None);
        assert_eq!(
            refusal("ab12 is unauthorized to Liveliness Token (ingress) on @ros2_lv/0/1/0/0/NN/%/%/n"),
            None
        );
        let word = crate::origin::ended(0, 1, 7);
        assert_eq!(refusal(&format!("ab12 is unauthorized to Liveliness Token (ingress) on {word}")), None);
    }
}
