// SPDX-License-Identifier: MIT OR Apache-2.0
//! A context: a participant of a domain, its helper thread, and the waiters of its wait sets.

use crate::bindings::*;
use crate::error::{Error, Result};
use crate::handle::{
    Handle, IDENTIFIER, behind, check_identifier, check_initialised, check_zero, exported, take_back, text,
};
use crate::helper::{Helper, Ring};
use crate::notifier::{Notifier, NotifierWaker};
use crate::on_new::{Listener, ListenersByName};
use crate::options::{self, rmw_init_options_copy, rmw_init_options_fini};
use crate::signal::{Signal, Waiter};
use crate::system::System;
use crate::{lend, log};
use futures::StreamExt;
use std::ffi::{c_char, c_void};
use std::future::poll_fn;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::task::{Context as TaskContext, Waker};
use tautline_rt::FutexWord;
use tautline_rt::fork::ProcessMark;
use tautline_system::{environment, switch_of_environment};
use tautline_trace::SamplerObject;
use tautline_transport::{GraphEvents, Participant, Slot, Wakeable};

pub(crate) struct Context {
    // Dropped in this order: the helper serves the participant, and the last participant removes the domain's folder, which must
    // be empty by then.
    notifier: Notifier,
    pub(crate) helper: Helper,
    pub(crate) system: System,
    pub(crate) participant: Participant,
    /// The enclave of the context's nodes.
    pub(crate) enclave: String,
    /// Existing nodes.
    pub(crate) nodes: AtomicUsize,
    watchers: Arc<Watchers>,
    pub(crate) waiters: Arc<Waiters>,
    /// The context's endpoints with callbacks for new messages.
    pub(crate) listeners: ListenersByName,
    /// The context's waits, for trace events.
    pub(crate) waits: Arc<SamplerObject>,
}

impl Handle for rmw_context_t {
    type Data = Context;
    const WHAT: &'static str = "the context";

    fn identifier(&self) -> *const c_char {
        self.implementation_identifier
    }

    fn data(&self) -> *mut c_void {
        self.impl_.cast()
    }

    fn check(&self) -> Result {
        if self.implementation_identifier.is_null() {
            return Err(Error::invalid("the context has not been initialised, or was finalised"));
        }
        check_identifier(self.implementation_identifier, Self::WHAT)
    }
}

/// Signals to set when the graph changes.
#[derive(Default)]
struct Watchers(Mutex<Vec<Weak<Signal>>>);

impl Watchers {
    fn trigger(&self) {
        let mut signals = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        signals.retain(|signal| {
            signal.upgrade().is_some_and(|signal| {
                signal.set();
                true
            })
        });
    }
}

/// The waiters of a context's wait sets. None is dropped before its context and that context's wait sets, because a trigger of a guard
/// condition may still use it.
pub(crate) struct Waiters {
    /// The process that created the context: nothing wakes a thread of a forked child.
    process: ProcessMark,
    is_shut_down: AtomicBool,
    lists: Mutex<WaiterLists>,
}

#[derive(Default)]
struct WaiterLists {
    used: Vec<Arc<Waiter>>,
    free: Vec<Arc<Waiter>>,
}

impl Waiters {
    fn new() -> Self {
        let (is_shut_down, lists) = Default::default();
        Waiters { process: ProcessMark::new(), is_shut_down, lists }
    }

    /// Returns an error in a forked child, which cannot wait in its parent's context.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub(crate) fn check_process(&self) -> Result {
        match self.process.is_here() {
            true => Ok(()),
            false => Err(Error::other(
                "this process was forked from the one whose context this is: create a context of its own after the fork",
            )),
        }
    }

    /// `None` in a forked child: a thread of the parent may have held the lock at the fork.
    fn lists(&self) -> Option<MutexGuard<'_, WaiterLists>> {
        self.process.is_here().then(|| self.lists.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Ends all waits, and prevents new ones.
    fn shut_down(&self) {
        self.is_shut_down.store(true, Ordering::Release);
        // A woken thread sees the flag; a thread whose waiter is not in the list yet reads it before it sleeps.
        if let Some(lists) = self.lists() {
            lists.used.iter().for_each(|waiter| Wakeable::wake(&**waiter));
        }
    }

    /// Whether the context was shut down.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub(crate) fn is_shut_down(&self) -> bool {
        self.is_shut_down.load(Ordering::Acquire)
    }

    /// A waiter for one wait set, until it is [given back](Self::give_back).
    pub(crate) fn claim(&self, participant: &Participant) -> Arc<Waiter> {
        // No wait succeeds in a forked child.
        let Some(mut lists) = self.lists() else { return Arc::new(Waiter::Word(FutexWord::new(0))) };
        let WaiterLists { used, free } = &mut *lists;
        // An endpoint holds the waiter that it wakes, also between waits. Whoever got its bell would be woken by its messages, and have fewer
        // of the bell's bits.
        let is_bell = |waiter: &Arc<Waiter>| waiter.bell().is_some();
        let unused = free.iter().rposition(|waiter| is_bell(waiter) && Arc::strong_count(waiter) == 1);
        let waiter = match unused {
            Some(at) => free.swap_remove(at),
            None => match participant.doorbell().claim_thread_bell() {
                Ok(bell) => Arc::new(Waiter::Bell(bell)),
                // All are in use: rung for others is better than slower without a bell, but nothing is missed either way.
                Err(_) => match free.iter().rposition(is_bell).or(free.len().checked_sub(1)) {
                    Some(at) => free.swap_remove(at),
                    None => Arc::new(Waiter::Word(FutexWord::new(0))),
                },
            },
        };
        used.push(waiter.clone());
        waiter
    }

    /// Exchanges a claimed waiter for another one, if that is free.
    pub(crate) fn exchange(&self, own: &mut Arc<Waiter>, other: Arc<Waiter>) {
        let Some(mut lists) = self.lists() else { return };
        let WaiterLists { used, free } = &mut *lists;
        let place =
            |list: &[Arc<Waiter>], waiter: &Arc<Waiter>| list.iter().position(|one| Arc::ptr_eq(one, waiter));
        if let (Some(used_at), Some(free_at)) = (place(used, own), place(free, &other)) {
            std::mem::swap(&mut used[used_at], &mut free[free_at]);
            *own = other;
        }
    }

    pub(crate) fn give_back(&self, waiter: &Arc<Waiter>) {
        let Some(mut lists) = self.lists() else { return };
        let WaiterLists { used, free } = &mut *lists;
        used.retain(|one| !Arc::ptr_eq(one, waiter));
        free.push(waiter.clone());
    }
}

impl Context {
    fn join(domain: u32, enclave: &str) -> Result<Self> {
        let participant = Participant::new(domain)?;
        // After the participant, because the statistics file is in the domain's folder.
        let system = System::of_environment(domain)?;
        let waits = Arc::new(tautline_trace::sampler_init(participant.trace_id(), "rmw_wait"));
        let helper = Helper::start(&participant)?;
        let watchers = Arc::<Watchers>::default();
        let (events, slot) = (participant.graph_events()?, Arc::new(participant.claim_slot()?));
        let watched = watchers.clone();
        helper.run(move || signal_changes(events, slot, watched));
        let (nodes, waiters) = (AtomicUsize::new(0), Arc::new(Waiters::new()));
        Ok(Context {
            notifier: Notifier::default(),
            helper,
            participant,
            enclave: enclave.to_owned(),
            nodes,
            watchers,
            waiters,
            listeners: ListenersByName::default(),
            waits,
            system,
        })
    }

    /// Registers an endpoint with a callback for new messages at the notifier. Returns the waker for the endpoint's rings. `priority` is
    /// that of the thread to which the system file assigns the callback.
    pub(crate) fn serve(
        &self,
        endpoint: Weak<dyn Listener>,
        priority: Option<u8>,
    ) -> Result<Arc<NotifierWaker>> {
        self.notifier.serve(endpoint, priority, || self.waiters.claim(&self.participant))
    }

    /// Sets `signal` when the graph changes, as long as it exists.
    pub(crate) fn watch_graph(&self, signal: &Arc<Signal>) {
        self.watchers.0.lock().unwrap_or_else(PoisonError::into_inner).push(Arc::downgrade(signal));
    }

    /// Whether this process created the context. A forked child does not touch the data of ROS's handles, because threads of the parent may
    /// have held its locks at the fork.
    pub(crate) fn is_of_this_process(&self) -> bool {
        self.waiters.process.is_here()
    }

    /// An error if the context was shut down.
    pub(crate) fn check(&self) -> Result {
        match self.waiters.is_shut_down() {
            false => Ok(()),
            true => Err(Error::invalid("the context was shut down")),
        }
    }
}

async fn signal_changes(mut events: GraphEvents, slot: Arc<Slot>, watchers: Arc<Watchers>) {
    // The graph's thread wakes this task with a ring of the doorbell.
    let ring = Waker::from(Arc::new(Ring(slot.clone())));
    loop {
        let event = poll_fn(|context| {
            slot.waker().register(context.waker());
            events.poll_next_unpin(&mut TaskContext::from_waker(&ring))
        });
        if event.await.is_none() {
            return;
        }
        watchers.trigger();
    }
}

/// Applies the environment's settings: whether freed memory is reused without page faults, unless the program has its own settings of the
/// C library; and whether serialized messages are samples.
fn memory_of_environment() -> Result {
    const OWN: [&str; 5] = [
        "GLIBC_TUNABLES",
        "MALLOC_MMAP_MAX_",
        "MALLOC_MMAP_THRESHOLD_",
        "MALLOC_TOP_PAD_",
        "MALLOC_TRIM_THRESHOLD_",
    ];
    let is_free = || OWN.iter().all(|variable| environment(variable).is_none());
    if switch_of_environment("TAUT_KEEP_MEMORY")?.unwrap_or_else(is_free) {
        tautline_rt::keep_freed_memory();
    }
    lend::allow(switch_of_environment("TAUT_LEND")?.unwrap_or(true));
    Ok(())
}

exported! {
    fn rmw_init(
        options: *const rmw_init_options_t => given "the options",
        context: *mut rmw_context_t => place "the context",
    ) {
        check_initialised(options.implementation_identifier, "the options")?;
        check_zero(context.implementation_identifier, "the context")?;
        log::start();
        memory_of_environment()?;
        // ROS's logging library would wait for its thread, which a forked child does not have.
        tautline_rt::exempt_children();
        let domain = options::check(options)?;
        // SAFETY: rmw's contract; checked not to be null.
        let made = Context::join(domain, unsafe { text(options.enclave, "the enclave")? })?;
        context.instance_id = options.instance_id;
        context.actual_domain_id = domain as usize;
        // SAFETY: zero-initialised, as the context is.
        options::copied(unsafe { rmw_init_options_copy(options, &mut context.options) })?;
        context.implementation_identifier = IDENTIFIER.as_ptr();
        context.impl_ = Box::into_raw(Box::new(made)).cast();
        Ok(())
    }

    fn rmw_shutdown(context: *mut rmw_context_t => behind) {
        context.waiters.shut_down();
        Ok(())
    }

    fn rmw_context_fini(context: *mut rmw_context_t) {
        // SAFETY: rmw's contract.
        let behind = unsafe { behind(context)? };
        if !behind.waiters.is_shut_down() {
            return Err(Error::invalid("the context is not shut down"));
        }
        let nodes = behind.nodes.load(Ordering::Acquire);
        if nodes != 0 {
            return Err(Error::other(format!("the context still has {nodes} nodes: destroy them first")));
        }
        // SAFETY: rmw's contract: no longer used, and created by `rmw_init`.
        unsafe {
            let is_ours = behind.is_of_this_process();
            let behind = take_back::<Context>((*context).impl_.cast());
            if is_ours {
                drop(behind)
            } else {
                std::mem::forget(behind)
            }
            let finished = rmw_init_options_fini(&mut (*context).options);
            context.write(rmw_get_zero_initialized_context());
            options::copied(finished)
        }
    }
}
