// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wait sets: `rmw_wait` checks everything, sleeps until it is rung, and checks everything again.

use crate::bindings::*;
use crate::client::Client;
use crate::context::Waiters;
use crate::distro;
use crate::error::{Error, Result, answer};
use crate::event;
use crate::guard::GuardCondition;
use crate::handle::{IDENTIFIER, behind, exported, handle, take_back};
use crate::job::{self, Jobs};
use crate::service::Service;
use crate::signal::{Signal, Waiter};
use crate::subscription::Subscription;
use crate::thread;
use std::ffi::c_void;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tautline_rt::PiMutex;
use tautline_rt::clock::monotonic_ns;
use tautline_trace::SamplerObject;

pub(crate) struct WaitSet {
    waiters: Arc<Waiters>,
    waiter: PiMutex<Arc<Waiter>>,
    has_slept: AtomicBool,
    waits: Arc<SamplerObject>,
    /// Whether callbacks' processor time is measured.
    is_measured: bool,
    in_use: AtomicBool,
}

handle!(rmw_wait_set_t, WaitSet, "the wait set");

impl WaitSet {
    /// What its thread sleeps on. Before it sleeps for the first time, that becomes what the endpoints already ring, if no wait set has it:
    /// rclpy makes a wait set for each wait, and endpoints would be told of another bell each time.
    ///
    /// # Real-time
    /// No allocation; no syscall; the first time O(wait sets of the context + entities), and it waits for threads that create or destroy wait
    /// sets.
    fn waiter(&self, wanted: &WaitEntities) -> Arc<Waiter> {
        let own = &mut *self.waiter.lock();
        if !self.has_slept.swap(true, Ordering::Relaxed)
            && let Some(rung) = wanted.rung()
        {
            self.waiters.exchange(own, rung);
        }
        own.clone()
    }
}

/// A thread's use of a wait set, until dropped.
struct Turn<'a>(&'a AtomicBool);

impl<'a> Turn<'a> {
    fn of(wait_set: &'a WaitSet) -> Result<Self> {
        match wait_set.in_use.swap(true, Ordering::Acquire) {
            false => Ok(Turn(&wait_set.in_use)),
            true => Err(Error::other("two threads wait with one wait set: use one per thread")),
        }
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Release);
    }
}

/// Pointers given to rmw_wait, which sets those that are not ready to null.
struct Array<'a>(&'a mut [*mut c_void]);

impl Array<'_> {
    /// # Safety
    /// `data` is null or has `count` elements, which nothing else uses meanwhile.
    unsafe fn new(data: *mut *mut c_void, count: usize) -> Self {
        // SAFETY: the caller's contract.
        Array(if data.is_null() { &mut [] } else { unsafe { std::slice::from_raw_parts_mut(data, count) } })
    }

    /// # Safety
    /// Each is null or points to a live `T`.
    unsafe fn all<'t, T: 't>(&self) -> impl Iterator<Item = &'t T> {
        // SAFETY: the caller's contract.
        self.0.iter().filter_map(|one| unsafe { one.cast::<T>().as_ref() })
    }

    /// The number of entities before the first one that is ready.
    ///
    /// # Safety
    /// As [`all`](Self::all).
    unsafe fn idle<T>(&self, is_ready: impl Fn(&T) -> bool) -> usize {
        // SAFETY: the caller's contract.
        let is_ready = |one: &*mut c_void| unsafe { one.cast::<T>().as_ref() }.is_some_and(&is_ready);
        self.0.iter().position(is_ready).unwrap_or(self.0.len())
    }

    /// Sets entities that are not ready to null: the first `idle`, and of the others those that are not.
    ///
    /// # Safety
    /// As [`all`](Self::all).
    unsafe fn keep<T>(&mut self, idle: usize, mut is_ready: impl FnMut(&T) -> bool) {
        for (index, one) in self.0.iter_mut().enumerate() {
            // SAFETY: the caller's contract.
            if index < idle || !unsafe { one.cast::<T>().as_ref() }.is_some_and(&mut is_ready) {
                *one = std::ptr::null_mut();
            }
        }
    }
}

/// The entities to wait for.
struct WaitEntities<'a> {
    subscriptions: Array<'a>,
    guards: Array<'a>,
    services: Array<'a>,
    clients: Array<'a>,
    events: Array<'a>,
}

/// For each array, the number of entities from its start that the last check found without a message. They are not checked again.
#[derive(Clone, Copy, Default)]
struct Idle {
    subscriptions: usize,
    services: usize,
    clients: usize,
}

impl WaitEntities<'_> {
    fn subscriptions(&self) -> impl Iterator<Item = &Subscription> {
        // SAFETY: rmw's contract of `rmw_wait`: the pointers are our data of such handles, and live. Also below.
        unsafe { self.subscriptions.all() }
    }

    fn services(&self) -> impl Iterator<Item = &Service> {
        // SAFETY: as above.
        unsafe { self.services.all() }
    }

    fn clients(&self) -> impl Iterator<Item = &Client> {
        // SAFETY: as above.
        unsafe { self.clients.all() }
    }

    fn guards(&self) -> impl Iterator<Item = &GuardCondition> {
        // SAFETY: as above.
        unsafe { self.guards.all() }
    }

    fn signals(&self) -> impl Iterator<Item = &Signal> {
        // SAFETY: as above; for events, the pointers are the handles.
        let events = unsafe { self.events.all::<rmw_event_t>() }.filter_map(event::signal_of);
        self.guards().map(|guard| &*guard.signal).chain(events)
    }

    /// Checks entities until one is ready. Returns those that are not, and whether one is.
    ///
    /// # Real-time
    /// O(entities); no allocation; no syscall, except one futex wake for memory that is not mapped here yet. Waits for threads
    /// that take from or publish on one of them, which inherit this thread's priority.
    fn find_ready(&self) -> (Idle, bool) {
        let mut idle = Idle::default();
        if self.signals().any(Signal::is_set) {
            return (idle, true);
        }
        let WaitEntities { subscriptions, services, clients, .. } = self;
        // SAFETY: as above.
        unsafe {
            idle.subscriptions = subscriptions.idle(Subscription::has_data);
            if idle.subscriptions == subscriptions.0.len() {
                idle.services = services.idle(|one: &Service| one.end().has_data());
                idle.clients = clients.idle(|one: &Client| one.end().has_data());
            }
        }
        let has_any = idle.subscriptions < subscriptions.0.len()
            || idle.services < services.0.len()
            || idle.clients < clients.0.len();
        (idle, has_any)
    }

    /// The bell that the first of the endpoints with one rings.
    fn rung(&self) -> Option<Arc<Waiter>> {
        let ends = self.subscriptions().map(|one| one.end().bell());
        let ends = ends.chain(self.services().map(|one| one.end().bell()));
        ends.chain(self.clients().map(|one| one.end().bell())).flatten().next()
    }

    /// Lets flags wake `waiter`, until it is detached.
    fn attach_signals(&self, waiter: &Waiter) -> Result {
        for signal in self.signals() {
            // SAFETY: a waiter lives as long as its context, which outlives uses of its guard conditions and endpoints.
            if !unsafe { signal.attach(waiter) } {
                return Err(Error::other(
                    "a guard condition or an event is already in 8 waiting wait sets, the limit: use fewer",
                ));
            }
        }
        Ok(())
    }

    /// Lets new messages wake `waiter`, once.
    ///
    /// # Real-time
    /// As [`ReceivingEndpoint::attach`](crate::end::ReceivingEndpoint::attach), for each.
    fn attach_data(&self, waiter: &Arc<Waiter>) {
        self.subscriptions().for_each(|subscription| subscription.end().attach(waiter));
        self.services().for_each(|service| service.end().attach(waiter));
        self.clients().for_each(|client| client.end().attach(waiter));
    }

    /// Detaches everything after the wait.
    fn detach(&self, waiter: &Waiter) {
        self.signals().for_each(|signal| signal.detach(waiter));
        self.subscriptions().for_each(|subscription| subscription.end().detach());
        self.services().for_each(|service| service.end().detach());
        self.clients().for_each(|client| client.end().detach());
    }

    /// Waits until something is ready, until `deadline_ns`, or until the context is shut down.
    ///
    /// # Real-time
    /// As [`find_ready`](Self::find_ready) for each ring, and a syscall to sleep.
    fn wait(&self, wait_set: &WaitSet, waiter: &Arc<Waiter>, deadline_ns: Option<u64>) -> Idle {
        loop {
            let count = waiter.count();
            self.attach_data(waiter);
            let is_over = deadline_ns.is_some_and(|deadline_ns| monotonic_ns() >= deadline_ns);
            let (idle, is_ready) = self.find_ready();
            if is_ready || is_over || wait_set.waiters.is_shut_down() {
                return idle;
            }
            waiter.sleep(count, deadline_ns);
        }
    }

    fn jobs(&self) -> impl Iterator<Item = &Jobs> {
        let subscriptions = self.subscriptions().map(|one| one.end().jobs());
        let services = self.services().map(|one| one.end().jobs());
        subscriptions.chain(services).chain(self.clients().map(|one| one.end().jobs()))
    }

    /// Makes this thread the one that runs the callbacks, and records the first wait for each of them.
    ///
    /// # Real-time
    /// As [`thread::govern`].
    fn govern(&self) -> Result {
        let mut has_new = false;
        let jobs = self.jobs().inspect(|jobs| has_new |= jobs.is_new());
        thread::govern(jobs.filter_map(|jobs| jobs.thread.as_ref()))?;
        if has_new {
            let now_ns = monotonic_ns();
            self.jobs().for_each(|jobs| jobs.wait_for(now_ns));
        }
        Ok(())
    }

    /// Keeps ready entities, of those with messages only the ones with the highest rank, and resets guard conditions. The next wait finds
    /// the others, and those that were idle at the last check. Returns whether any entity is ready.
    fn report(&mut self, idle: Idle) -> bool {
        // Entities without a rank are below all others. Entities below a ready one are not checked.
        let mut highest = None;
        let mut is_candidate = |rank: Option<u8>, has_data: &dyn Fn() -> bool| {
            let is_it = rank >= highest && has_data();
            if is_it {
                highest = rank;
            }
            is_it
        };
        // SAFETY: as above.
        unsafe {
            self.subscriptions.keep(idle.subscriptions, |one: &Subscription| {
                is_candidate(one.end().rank(), &|| one.has_data())
            });
            self.services.keep(idle.services, |one: &Service| {
                is_candidate(one.end().rank(), &|| one.end().has_data())
            });
            self.clients
                .keep(idle.clients, |one: &Client| is_candidate(one.end().rank(), &|| one.end().has_data()));
            if highest.is_some() {
                self.subscriptions.keep(0, |one: &Subscription| one.end().rank() == highest);
                self.services.keep(0, |one: &Service| one.end().rank() == highest);
                self.clients.keep(0, |one: &Client| one.end().rank() == highest);
            }
            self.guards.keep(0, |guard: &GuardCondition| guard.signal.take());
            self.events.keep(0, |event| event::signal_of(event).is_some_and(Signal::is_set));
        }
        let all = [&self.subscriptions, &self.services, &self.clients, &self.guards, &self.events];
        all.iter().any(|array| array.0.iter().any(|one| !one.is_null()))
    }
}

/// Detaches the waiter when dropped.
struct Attached<'a> {
    wanted: &'a WaitEntities<'a>,
    waiter: &'a Arc<Waiter>,
}

impl Drop for Attached<'_> {
    fn drop(&mut self) {
        self.wanted.detach(self.waiter);
    }
}

exported! {
    fn rmw_create_wait_set(
        context: *mut rmw_context_t => behind,
        _max_conditions: usize,
    ) -> *mut rmw_wait_set_t {
        // SAFETY: no conditions.
        let handle = unsafe { rmw_wait_set_allocate() };
        if handle.is_null() {
            return Err(Error::new(RET_BAD_ALLOC, "no memory for a wait set"));
        }
        let waiter = PiMutex::new(context.waiters.claim(&context.participant));
        let (waiters, waits) = (context.waiters.clone(), context.waits.clone());
        let (is_measured, has_slept, in_use) = (context.system.measures_execution(), false.into(), false.into());
        let wait_set = WaitSet { waiters, waiter, has_slept, waits, is_measured, in_use };
        // SAFETY: rmw's memory, written before anyone can see it.
        unsafe {
            handle.write(rmw_wait_set_t {
                implementation_identifier: IDENTIFIER.as_ptr(),
                guard_conditions: std::ptr::null_mut(),
                data: Box::into_raw(Box::new(wait_set)).cast(),
            });
        }
        Ok(handle)
    }

    fn rmw_destroy_wait_set(handle: *mut rmw_wait_set_t) {
        if handle.is_null() {
            return Err(distro::null_argument("the wait set"));
        }
        // SAFETY: rmw's contract; checked to be ours.
        unsafe {
            behind(handle)?;
            let wait_set = take_back::<WaitSet>((*handle).data);
            wait_set.waiters.give_back(&wait_set.waiter.lock());
            rmw_wait_set_free(handle);
        }
        Ok(())
    }
}

/// # Safety
/// As documented by rmw.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rmw_wait(
    subscriptions: *mut rmw_subscriptions_t,
    guard_conditions: *mut rmw_guard_conditions_t,
    services: *mut rmw_services_t,
    clients: *mut rmw_clients_t,
    events: *mut rmw_events_t,
    wait_set: *mut rmw_wait_set_t,
    timeout: *const rmw_time_t,
) -> rmw_ret_t {
    let mut is_over = false;
    let answered = answer(|| {
        // SAFETY: rmw's contract: each is null or valid.
        let (wait_set, timeout, mut wanted) = unsafe {
            let none = || (std::ptr::null_mut(), 0);
            let array = |(data, count)| Array::new(data, count);
            let wanted = WaitEntities {
                subscriptions: array(
                    subscriptions.as_ref().map_or_else(none, |all| (all.subscribers, all.subscriber_count)),
                ),
                guards: array(
                    guard_conditions
                        .as_ref()
                        .map_or_else(none, |all| (all.guard_conditions, all.guard_condition_count)),
                ),
                services: array(services.as_ref().map_or_else(none, |all| (all.services, all.service_count))),
                clients: array(clients.as_ref().map_or_else(none, |all| (all.clients, all.client_count))),
                events: array(events.as_ref().map_or_else(none, |all| (all.events, all.event_count))),
            };
            (behind(wait_set)?, timeout.as_ref(), wanted)
        };
        wait_set.waiters.check_process()?;
        let _turn = Turn::of(wait_set)?;
        if wait_set.is_measured {
            thread::raise();
            wanted.govern()?;
        }
        let timeout_ns = timeout.map(|time| time.sec.saturating_mul(1_000_000_000).saturating_add(time.nsec));
        job::wait(&wait_set.waits, timeout_ns, wait_set.is_measured);
        // Usually something is already ready, and nothing has to be attached.
        let (idle, is_ready) = wanted.find_ready();
        let waited = if is_ready || timeout_ns == Some(0) {
            Ok(idle)
        } else {
            let waiter = &wait_set.waiter(&wanted);
            let _attached = Attached { wanted: &wanted, waiter };
            let has_room = wanted.attach_signals(waiter);
            let deadline_ns = timeout_ns.map(|timeout_ns| monotonic_ns().saturating_add(timeout_ns));
            has_room.map(|()| wanted.wait(wait_set, waiter, deadline_ns))
        };
        let is_ready = wanted.report(waited?);
        job::wake(&wait_set.waits, is_ready);
        // Another thread may have taken it, or the context was shut down; without a time limit this is no timeout.
        is_over = !is_ready && timeout.is_some();
        if is_over && timeout_ns == Some(0) && wait_set.is_measured {
            // Whoever polls may do so for another thread of the executor, which has the same priority and the same core.
            std::thread::yield_now();
        }
        Ok(())
    });
    if answered == RET_OK && is_over { RET_TIMEOUT } else { answered }
}
