// SPDX-License-Identifier: MIT OR Apache-2.0
//! A context's helper thread: in place of the sampler, it serves everything except data. QoS events, graph changes and requests that
//! wait for a server are tasks of its pool.

use crate::error::{self, Error, Result};
use futures::FutureExt;
use futures::executor::LocalPool;
use futures::future::LocalBoxFuture;
use futures::task::LocalSpawnExt;
use std::any::Any;
use std::panic::AssertUnwindSafe;
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, PoisonError};
use std::task::Wake;
use tautline_rt::{JoinHandle, Realtime, RtError, ThreadBuilder};
use tautline_sampler::{Events, Sampler};
use tautline_transport::{Participant, Slot};

type Task = Box<dyn FnOnce() -> LocalBoxFuture<'static, ()> + Send>;

/// The thread, and its queue of tasks.
pub(crate) struct Helper {
    events: Events,
    tasks: Mutex<Sender<Task>>,
    /// Rung for new tasks.
    door: Arc<Slot>,
    thread: Option<JoinHandle<()>>,
}

/// Wakes a task of the helper from any thread, with a ring, because the thread sleeps only on the doorbell.
pub(crate) struct Ring(pub(crate) Arc<Slot>);

impl Wake for Ring {
    fn wake(self: Arc<Self>) {
        self.0.ring();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.0.ring();
    }
}

/// Builds a thread without real-time priority, whatever thread starts it; if that has none either, its nice value is inherited.
pub(crate) fn ordinary_thread(name: &str) -> std::result::Result<ThreadBuilder, RtError> {
    let builder = ThreadBuilder::new(name);
    Ok(match tautline_rt::current_policy()?.realtime_priority() {
        Some(_) => builder,
        None => builder.realtime(Realtime::Off),
    })
}

impl Helper {
    /// Starts the thread, as SCHED_OTHER.
    pub(crate) fn start(participant: &Participant) -> Result<Self> {
        let sampler = Sampler::new(participant)?;
        let (events, door) = (sampler.events().clone(), Arc::new(participant.claim_slot()?));
        let (tasks, given) = channel();
        let thread = ordinary_thread("rmw_helper")
            .and_then(|thread| thread.spawn(move || move || serve(sampler, &given)));
        let thread = thread.map_err(Error::other)?;
        Ok(Helper { events, tasks: Mutex::new(tasks), door, thread: Some(thread) })
    }

    /// The sampler's events, which wake the helper's tasks.
    pub(crate) fn events(&self) -> &Events {
        &self.events
    }

    /// Creates a task in the thread, and runs it.
    pub(crate) fn run<F: Future<Output = ()> + 'static>(&self, make: impl FnOnce() -> F + Send + 'static) {
        // A panic ends only its task: the thread is needed by others.
        let task: Task = Box::new(move || {
            let task = AssertUnwindSafe(async move { make().await }).catch_unwind();
            let said = |panic: Box<dyn Any + Send>| tracing::error!("{}", error::panic_text(&*panic));
            Box::pin(task.map(move |ended| ended.unwrap_or_else(said)))
        });
        let tasks = self.tasks.lock().unwrap_or_else(PoisonError::into_inner);
        // Fails only after the thread has ended, when no task is needed any more.
        let _ = tasks.send(task);
        self.door.ring();
    }
}

impl Drop for Helper {
    fn drop(&mut self) {
        self.events.stop();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn serve(mut sampler: Sampler, given: &Receiver<Task>) {
    let events = sampler.events().clone();
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    while !events.is_stopped() {
        for task in given.try_iter() {
            let _ = spawner.spawn_local(task());
        }
        pool.run_until_stalled();
        sampler.spin_once(None);
    }
}
