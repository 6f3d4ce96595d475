// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wakes tasks when the graph changes: one thread sleeps on the domain's epoch for all tasks of a participant. Whoever changes what the
//! participant's endpoints match wakes them, too.

use crate::error::TransportError;
use crate::graph::domain::Domain;
use crate::low_priority::low_priority_thread;
use futures::Stream;
use futures::task::AtomicWaker;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::task::{Context, Poll};
use tautline_rt::{JoinHandle, PiMutex};

/// A stream that yields an item when a node, publisher, subscription, service or client of the domain has appeared or
/// disappeared since its last item, or since the stream was created, and when an endpoint of its participant has been connected or
/// disconnected. Several changes may be one item. The stream ends with its participant.
///
/// To wait for a state of the graph, create the stream first, then read the graph, then await the next event, then read the
/// graph again.
pub struct GraphEvents {
    domain: Arc<Domain>,
    listener: Arc<Listener>,
    seen: (u32, u32),
}

struct Listener {
    waker: AtomicWaker,
    all: Arc<GraphListeners>,
}

/// The tasks of a participant that wait for changes.
#[derive(Default)]
pub(crate) struct GraphListeners {
    list: PiMutex<Vec<Weak<Listener>>>,
    /// How often the matches of the participant's endpoints have changed.
    matches: AtomicU32,
    stop: AtomicBool,
}

/// The listeners of a participant, and their thread once there is one.
pub(crate) struct GraphWatcher {
    domain: Arc<Domain>,
    pub(crate) listeners: Arc<GraphListeners>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl GraphWatcher {
    pub(crate) fn new(domain: Arc<Domain>) -> Self {
        GraphWatcher { domain, listeners: Arc::default(), thread: Mutex::default() }
    }

    pub(crate) fn subscribe(&self) -> Result<GraphEvents, TransportError> {
        let mut thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        if thread.is_none() {
            let (domain, listeners) = (self.domain.clone(), self.listeners.clone());
            let builder = low_priority_thread("graph").map_err(TransportError::Thread)?;
            let run = move || move || watch(&domain, &listeners);
            *thread = Some(builder.spawn(run).map_err(TransportError::Thread)?);
        }
        let listener = Arc::new(Listener { waker: AtomicWaker::new(), all: self.listeners.clone() });
        let mut list = self.listeners.list.lock();
        list.retain(|listener| listener.strong_count() > 0);
        list.push(Arc::downgrade(&listener));
        Ok(GraphEvents { domain: self.domain.clone(), listener, seen: self.listeners.changes(&self.domain) })
    }
}

impl Drop for GraphWatcher {
    fn drop(&mut self) {
        // Release: pairs with the Acquire of the thread and of the listeners.
        self.listeners.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.get_mut().unwrap_or_else(PoisonError::into_inner).take() {
            // Changes the epoch only to wake the thread, which may be between its check of `stop` and its sleep.
            self.domain.advance();
            let _ = thread.join();
        }
        self.listeners.wake_all();
    }
}

fn watch(domain: &Domain, listeners: &GraphListeners) {
    let mut seen = domain.epoch().wrapping_sub(1);
    while !listeners.stop.load(Ordering::Acquire) {
        seen = domain.wait(seen, None);
        listeners.wake_all();
    }
}

impl GraphListeners {
    /// Announces that the matches of the participant's endpoints have changed.
    ///
    /// # Real-time
    /// O(listeners), which it wakes. Waits for another thread that does, which inherits this thread's priority.
    pub(crate) fn advance_matches(&self) {
        self.matches.fetch_add(1, Ordering::Release);
        self.wake_all();
    }

    /// The domain's epoch, and the number of changes of matches.
    fn changes(&self, domain: &Domain) -> (u32, u32) {
        // Acquire: pairs with the Release in `advance_matches`; the counts of matches that are read after this show that change.
        (domain.epoch(), self.matches.load(Ordering::Acquire))
    }

    fn wake_all(&self) {
        let mut list = self.list.lock();
        list.retain(|listener| {
            listener.upgrade().is_some_and(|listener| {
                listener.waker.wake();
                true
            })
        });
    }
}

impl Stream for GraphEvents {
    type Item = ();

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<()>> {
        // Registered before the changes are read: a change after this wakes the task.
        self.listener.waker.register(cx.waker());
        let changes = self.listener.all.changes(&self.domain);
        if changes != self.seen {
            self.seen = changes;
            return Poll::Ready(Some(()));
        }
        match self.listener.all.stop.load(Ordering::Acquire) {
            true => Poll::Ready(None),
            false => Poll::Pending,
        }
    }
}

tautline_rt::debug_fields!(GraphEvents, |this| seen = this.seen);
