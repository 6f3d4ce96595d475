// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that calls callbacks for messages of other contexts. Publishers wake it as they wake a thread in `rmw_wait`.

use crate::error::{Error, Result};
use crate::on_new::Listener;
use crate::signal::Waiter;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::task::Wake;
use tautline_rt::{JoinHandle, PiMutex, Policy, Realtime, ThreadBuilder, current_policy};
use tautline_transport::Wakeable;

/// The thread of a context; started by the first callback.
#[derive(Default)]
pub(crate) struct Notifier(Mutex<Option<Started>>);

struct Started {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    waiter: Arc<Waiter>,
    endpoints: PiMutex<Arc<[Served]>>,
    /// The SCHED_FIFO priority that the thread is to have; 0: it is ordinary.
    priority: AtomicU8,
    is_stopped: AtomicBool,
}

type Served = (Weak<dyn Listener>, Arc<NotifierWaker>);

/// The target of an endpoint's rings while no thread waits for it: wakes the notifier.
pub(crate) struct NotifierWaker {
    is_rung: AtomicBool,
    pub(crate) waiter: Arc<Waiter>,
}

impl Wake for NotifierWaker {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.is_rung.store(true, Ordering::Release);
        Wakeable::wake(&*self.waiter);
    }
}

impl Notifier {
    /// Serves `endpoint` from now on. The thread runs at least at `priority`, and at that of the calling thread.
    pub(crate) fn serve(
        &self,
        endpoint: Weak<dyn Listener>,
        priority: Option<u8>,
        claim: impl FnOnce() -> Arc<Waiter>,
    ) -> Result<Arc<NotifierWaker>> {
        let mut started = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let shared = match &mut *started {
            Some(started) => &started.shared,
            none => &none.insert(Started::new(claim())?).shared,
        };
        let own = match current_policy() {
            Ok(Policy::Fifo(own) | Policy::RoundRobin(own)) => Some(own),
            _ => None,
        };
        if let Some(priority) = priority.max(own)
            && shared.priority.fetch_max(priority, Ordering::AcqRel) < priority
        {
            Wakeable::wake(&*shared.waiter);
        }
        let mut endpoints = shared.endpoints.lock();
        if let Some((_, waker)) = endpoints.iter().find(|(one, _)| Weak::ptr_eq(one, &endpoint)) {
            return Ok(waker.clone());
        }
        let waker =
            Arc::new(NotifierWaker { is_rung: AtomicBool::new(false), waiter: shared.waiter.clone() });
        let alive = endpoints.iter().filter(|(one, _)| one.strong_count() > 0).cloned();
        *endpoints = alive.chain([(endpoint, waker.clone())]).collect();
        Ok(waker)
    }
}

impl Started {
    fn new(waiter: Arc<Waiter>) -> Result<Self> {
        let (priority, is_stopped) = Default::default();
        let shared = Arc::new(Shared { waiter, endpoints: PiMutex::new(Arc::new([])), priority, is_stopped });
        // The thread has its starter's policy until it gets a priority: a process with a nice value may not lower that value.
        let thread = ThreadBuilder::new("rmw_notifier").realtime(Realtime::Off);
        let served = shared.clone();
        let thread = thread.spawn(move || move || served.run()).map_err(Error::other)?;
        Ok(Started { shared, thread: Some(thread) })
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        self.shared.is_stopped.store(true, Ordering::Release);
        Wakeable::wake(&*self.shared.waiter);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    /// # Real-time
    /// For each wake: a load for each endpoint with a callback, and O(publishers), the callback and a wait for the thread that uses the
    /// endpoint, which inherits this thread's priority, for each that was rung; one syscall to sleep.
    fn run(&self) {
        let mut own = 0;
        while !self.is_stopped.load(Ordering::Acquire) {
            let count = self.waiter.count();
            let wanted = self.priority.load(Ordering::Acquire);
            if wanted > own {
                own = wanted;
                if let Err(error) = tautline_rt::set_own_priority(own) {
                    tracing::warn!("callbacks for messages of other processes run without priority: {error}");
                }
            }
            let endpoints = self.endpoints.lock().clone();
            for (endpoint, waker) in &*endpoints {
                if waker.is_rung.swap(false, Ordering::AcqRel)
                    && let Some(endpoint) = endpoint.upgrade()
                {
                    endpoint.receive();
                }
            }
            self.waiter.sleep(count, None);
        }
    }
}
