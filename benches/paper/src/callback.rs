// SPDX-License-Identifier: MIT OR Apache-2.0

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use futures::{Stream, StreamExt};
use tautline_exchange::Log;
use tautline_rt::clock;

use crate::Topic;

/// A callback with its subscription: runs for as long as messages come.
pub type Callback = Pin<Box<dyn Future<Output = ()> + Send>>;

/// The callback of `topic`: computes for its execution time, then notes how long ago the message was due.
pub fn callback<M>(
    topic: &Topic,
    log: Arc<Log>,
    messages: impl Stream<Item = M> + Send + 'static,
    release_ns: impl Fn(&M) -> u64 + Send + 'static,
) -> Callback {
    let wcet = topic.wcet();
    Box::pin(messages.for_each(move |message| {
        clock::burn_cpu(wcet);
        log.note(clock::monotonic_ns().saturating_sub(release_ns(&message)));
        std::future::ready(())
    }))
}
