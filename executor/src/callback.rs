// SPDX-License-Identifier: MIT OR Apache-2.0
//! A spawned callback.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use tautline_rt::{JoinHandle, OwnPriority, RtError, ThreadInfo, current_tid};

use crate::hot::TaskControl;
use crate::registry::ThreadRegistration;
use crate::{CallbackStats, ExecutorError, Panic};

/// A handle to a callback and its thread. Dropping it has no effect, because the executor keeps the thread.
#[derive(Debug, Clone)]
pub struct CallbackHandle {
    callback: Arc<CallbackShared>,
}

impl CallbackHandle {
    pub(crate) fn new(callback: Arc<CallbackShared>) -> CallbackHandle {
        CallbackHandle { callback }
    }

    /// The callback's name, in full.
    pub fn name(&self) -> &str {
        self.callback.stats.name()
    }

    /// Its thread, as read back from the kernel at start.
    pub fn thread(&self) -> &ThreadInfo {
        &self.callback.info
    }

    /// Its statistics so far. For a group: the jobs of all its members.
    pub fn stats(&self) -> &Arc<CallbackStats> {
        &self.callback.stats
    }

    /// Requests the callback to end at its next wait, and returns without waiting for that. Its future is dropped on
    /// its own thread. A callback that never waits continues, unless its stream checks
    /// [`stop_requested`](crate::stop_requested).
    pub fn stop(&self) {
        self.callback.control.stop();
    }

    /// Whether the future has ended: by itself, because it was stopped, or with a panic.
    pub fn is_finished(&self) -> bool {
        self.callback.end.has_ended()
    }

    /// Waits until the future has ended and its thread has exited.
    ///
    /// # Errors
    /// [`ExecutorError::Panicked`] if the callback panicked, [`ExecutorError::JoinsItself`] on its own thread.
    pub fn join(self) -> Result<(), ExecutorError> {
        match self.callback.join()? {
            None => Ok(()),
            Some(panic) => Err(ExecutorError::Panicked { callbacks: vec![panic] }),
        }
    }
}

/// The state of a callback that the executor and its handles share.
pub(crate) struct CallbackShared {
    pub stats: Arc<CallbackStats>,
    /// The members of a group.
    pub members: Vec<Arc<CallbackStats>>,
    pub priority: Arc<OwnPriority>,
    pub control: Arc<TaskControl>,
    pub end: Arc<Completion>,
    pub info: ThreadInfo,
    pub thread: Mutex<Thread>,
}

/// The thread of a callback; after the join, its panic, if any.
pub(crate) struct Thread {
    pub running: Option<JoinHandle<()>>,
    pub panic: Option<Panic>,
}

impl CallbackShared {
    /// Waits for the thread; later callers get the same result.
    pub fn join(&self) -> Result<Option<Panic>, ExecutorError> {
        let name = || self.stats.name().to_owned();
        if self.info.tid == current_tid() {
            return Err(ExecutorError::JoinsItself { name: name() });
        }
        let mut thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(running) = thread.running.take() {
            thread.panic = match running.join() {
                Ok(()) | Err(RtError::Forked { .. }) => None,
                Err(RtError::Panicked { message, .. }) => Some(Panic { callback: name(), message }),
                Err(other) => Some(Panic { callback: name(), message: other.to_string() }),
            };
        }
        Ok(thread.panic.clone())
    }
}

impl fmt::Debug for CallbackShared {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Callback").field("name", &self.stats.name()).field("thread", &self.info).finish()
    }
}

/// Whether a callback's future has ended.
#[derive(Debug, Default)]
pub(crate) struct Completion(AtomicBool);

impl Completion {
    pub fn has_ended(&self) -> bool {
        // Acquire: pairs with the Release in `CompletionGuard`.
        self.0.load(Ordering::Acquire)
    }
}

/// Held by the thread while the future exists; its drop reports that the future has ended, for whatever reason.
pub(crate) struct CompletionGuard {
    pub end: Arc<Completion>,
    /// The statistics of all callbacks of the thread.
    pub stats: Vec<Arc<CallbackStats>>,
    pub _registration: ThreadRegistration,
}

impl Drop for CompletionGuard {
    fn drop(&mut self) {
        self.stats.iter().for_each(|stats| stats.end());
        self.end.0.store(true, Ordering::Release);
    }
}
