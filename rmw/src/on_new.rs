// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks for new messages, called by the publishing thread of the same context, without another thread in between.
//!
//! ```text
//!  publishing thread                          thread that sets a callback
//!  1 queue the message                        1 add the endpoint to the topic's listeners
//!  2 fence                                    2 tell publishers of this context not to ring; fence
//!  3 told not to ring? else ring              3 look into the queue
//!  4 call the topic's listeners
//! ```
//!
//! As with a ring, either the publisher calls the callback, or the endpoint sees the message in its queue. Publishers of other contexts
//! ring, and the notifier calls the callback.

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering, fence};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use tautline_rt::PiMutex;

/// An endpoint with a callback for new messages.
pub(crate) trait Listener: Send + Sync {
    /// Calls the callback for messages that were not reported yet.
    fn notify(&self);

    /// Like [`notify`](Self::notify), in the notifier after a ring; also routes the ring of the next message to the notifier.
    fn receive(&self);
}

/// The endpoints of a context that receive one topic and have a callback.
pub(crate) struct Listeners {
    count: AtomicUsize,
    endpoints: PiMutex<Arc<[Weak<dyn Listener>]>>,
}

impl Listeners {
    fn new() -> Self {
        Listeners { count: AtomicUsize::new(0), endpoints: PiMutex::new(Arc::new([])) }
    }

    /// Calls the callbacks. The caller has published on the topic, and holds no lock.
    ///
    /// # Real-time
    /// One load without callbacks; else O(listeners), the callbacks themselves, and a wait for each thread that takes from a
    /// listener or adds one, which inherits this thread's priority.
    pub(crate) fn notify(&self) {
        // Pairs with the fence in `change`: a publisher that was told not to ring sees the listener.
        fence(Ordering::Acquire);
        if self.count.load(Ordering::Relaxed) == 0 {
            return;
        }
        let endpoints = self.endpoints.lock().clone();
        endpoints.iter().filter_map(Weak::upgrade).for_each(|endpoint| endpoint.notify());
    }

    /// Adds an endpoint, once.
    pub(crate) fn add(&self, endpoint: Weak<dyn Listener>) {
        self.change(&endpoint, Some(endpoint.clone()));
    }

    pub(crate) fn remove(&self, endpoint: &Weak<dyn Listener>) {
        self.change(endpoint, None);
    }

    fn change(&self, endpoint: &Weak<dyn Listener>, added: Option<Weak<dyn Listener>>) {
        let mut endpoints = self.endpoints.lock();
        let others = endpoints.iter().filter(|other| !Weak::ptr_eq(other, endpoint)).cloned();
        let changed: Arc<[_]> = others.chain(added).collect();
        self.count.store(changed.len(), Ordering::Relaxed);
        *endpoints = changed;
        fence(Ordering::Release);
    }
}

/// The listeners of a context's topics, and of its services' requests and responses, by name.
#[derive(Default)]
pub(crate) struct ListenersByName(Mutex<HashMap<String, Weak<Listeners>>>);

impl ListenersByName {
    pub(crate) fn of(&self, name: &str) -> Arc<Listeners> {
        let mut names = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(listeners) = names.get(name).and_then(Weak::upgrade) {
            return listeners;
        }
        if names.len() == names.capacity() {
            names.retain(|_, listeners| listeners.strong_count() > 0);
        }
        let listeners = Arc::new(Listeners::new());
        names.insert(name.to_owned(), Arc::downgrade(&listeners));
        listeners
    }

    /// The listeners of a service's requests.
    pub(crate) fn of_requests(&self, service: &str) -> Arc<Listeners> {
        self.of(&format!("requests of {service}"))
    }

    /// The listeners of a service's responses.
    pub(crate) fn of_responses(&self, service: &str) -> Arc<Listeners> {
        self.of(&format!("responses of {service}"))
    }
}
