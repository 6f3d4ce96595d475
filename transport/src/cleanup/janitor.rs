// SPDX-License-Identifier: MIT OR Apache-2.0
//! The janitor: an ordinary thread of each participant, for work that no real-time thread may wait for. It sleeps until it is called:
//! by a participant that created or ended a port that concerns this one, by the warden that found a dead participant, or by a thread
//! of its own process.
//!
//! It calls the matcher (a function passed to it), which finds publishers and subscriptions for this participant's ports, completes
//! rings that a killed process began, checks whether this process is to be traced, and reports if this participant's file was removed.

use crate::error::TransportError;
use crate::graph::domain::Domain;
use crate::low_priority::low_priority_thread;
use crate::memory::file::OwnMemory;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tautline_doorbell::Doorbell;
use tautline_rt::clock::{monotonic_ns, nanoseconds};

/// The pauses before the next passes if work is left and nobody calls the janitor: each is longer than the one before.
const AGAIN: [Duration; 5] = [
    Duration::from_millis(1),
    Duration::from_millis(10),
    Duration::from_millis(100),
    Duration::from_secs(1),
    Duration::from_secs(10),
];

/// Connects the ports of its participant with those that it finds.
type Refresh = Box<dyn Fn() -> LookOutcome + Send + Sync>;

#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LookOutcome {
    /// Work is left that can only be completed later.
    pub(crate) is_pending: bool,
    pub(crate) has_gone: bool,
}

struct JanitorState {
    domain: Arc<Domain>,
    place: usize,
    doorbell: Arc<Doorbell>,
    memory: Arc<OwnMemory>,
    refresh: Refresh,
    attendant: OnceLock<Attendant>,
    stop: AtomicBool,
}

/// A further function that the janitor calls in each pass.
type Attendant = Box<dyn Fn() + Send + Sync>;

/// Handle of the janitor thread; dropping it ends the thread and waits for it.
pub(crate) struct Janitor {
    state: Arc<JanitorState>,
    thread: Option<tautline_rt::JoinHandle<()>>,
}

impl Janitor {
    pub(crate) fn start(
        domain: &Arc<Domain>,
        place: usize,
        doorbell: &Arc<Doorbell>,
        memory: &Arc<OwnMemory>,
        refresh: Refresh,
    ) -> Result<Self, TransportError> {
        let state = Arc::new(JanitorState {
            domain: domain.clone(),
            place,
            doorbell: doorbell.clone(),
            memory: memory.clone(),
            refresh,
            attendant: OnceLock::new(),
            stop: AtomicBool::new(false),
        });
        let thread = {
            let state = state.clone();
            let builder = low_priority_thread("janitor").map_err(TransportError::Thread)?;
            builder.spawn(move || move || run(&state)).map_err(TransportError::Thread)?
        };
        Ok(Janitor { state, thread: Some(thread) })
    }

    /// Sets a further function that the janitor calls in each pass. Only the first call has an effect.
    pub(crate) fn attend(&self, attendant: Attendant) {
        let _ = self.state.attendant.set(attendant);
    }
}

impl Drop for Janitor {
    fn drop(&mut self) {
        self.state.stop.store(true, Ordering::Release);
        self.state.domain.call(self.state.place);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn run(state: &JanitorState) {
    let calls = state.domain.calls(state.place);
    let (mut again, mut is_said, mut has_stand_in) = (0, false, false);
    loop {
        // Acquire: pairs with the Release of `Domain::call`; a call after this load ends the wait below at once.
        let seen = calls.0.load(Ordering::Acquire);
        if state.stop.load(Ordering::Acquire) {
            return;
        }
        let looked = (state.refresh)();
        if looked.has_gone {
            // A killed process may have been about to ring.
            state.doorbell.arena().rescue();
        }
        let is_traced = tautline_trace::attend();
        if let Some(attend) = state.attendant.get() {
            attend();
        }
        // A removal because this process ends does not count.
        let is_removed = !has_stand_in && state.memory.is_removed() && !state.domain.has_left();
        if is_removed {
            // So that the other participants notice when this process dies.
            has_stand_in = state.memory.make_stand_in().is_ok();
            if !std::mem::replace(&mut is_said, true) {
                log_removal(state.memory.path());
            }
        }
        let is_pending = looked.is_pending || is_removed && !has_stand_in;
        let pause = is_pending.then(|| AGAIN[again]);
        again = if is_pending { (again + 1).min(AGAIN.len() - 1) } else { 0 };
        let pause = match (pause, is_traced) {
            (pause, Some(period)) => Some(pause.map_or(period, |pause| pause.min(period))),
            (pause, None) => pause,
        };
        let until_ns = pause.map(|pause| monotonic_ns() + nanoseconds(pause));
        calls.wait(seen, until_ns);
        if calls.0.load(Ordering::Acquire) != seen {
            again = 0;
        }
    }
}

fn log_removal(path: &Path) {
    tracing::error!(
        "{} was removed while this process runs: processes that start from now on do not find it; restart it. If its user logged out, \
         systemd-logind did that: set RemoveIPC=no in /etc/systemd/logind.conf, or run it as a system user (docs/deployment.md)",
        path.display()
    );
}
