// SPDX-License-Identifier: MIT OR Apache-2.0
//! What enforces budgets on this machine, found and proven by enforcing one; timers and priorities that need the proof are made here.

use std::sync::Arc;
use std::time::Duration;

use crate::clock::{nanoseconds, thread_cpu_ns};
use crate::fork::ProcessMutex;
use crate::{
    BudgetTimer, Enforcement, OwnPriority, Policy, RtError, ThreadBuilder, budget, enforcer, set_policy_of,
};

/// What was proven in this process.
#[derive(Debug)]
struct State {
    /// What enforces the budgets of timers that are made from now on.
    chosen: Option<Enforcement>,
    /// The priority below which each kind was proven: 0 for none.
    proven_below: [u8; 2],
    /// The enforcer's thread and priority.
    enforcer: Option<(u32, u8)>,
}

static STATE: ProcessMutex<State> = ProcessMutex::new(State::new(), State::new);

/// The budget of the proof, and the processor time in which a timer must have ended it. A timer that is later is not used.
const BUDGET: Duration = Duration::from_micros(100);
const TIMER_PATIENCE: Duration = Duration::from_millis(2);
/// The same for the enforcer. There is nothing to use in its place, so a host that stalls it for a moment is no reason to refuse.
const ENFORCER_PATIENCE: Duration = Duration::from_millis(200);

/// Proves that budgets of threads below `SCHED_FIFO` priority `below` are enforced: starts a thread just below that priority which never
/// sleeps, gives it a budget, and sees whether it is demoted. First with its own timer; if that does not reach it, with the enforcer,
/// which then runs at priority `below`. Returns what works: later [`BudgetTimer`]s of this process use it, and the enforcer stays chosen.
///
/// # Real-time
/// Setup only. The proof takes 0.1 ms of a core at that priority, and 2 ms more where timers do not work; once in a process for each
/// higher `below`.
///
/// # Errors
/// [`RtError::BudgetNotEnforced`] with the fix; the errors of [`set_policy`](crate::set_policy).
pub fn prove_enforcement(below: u8) -> Result<Enforcement, RtError> {
    let mut state = STATE.lock();
    if let Some(by) = state.chosen.filter(|by| state.is_proven(*by, below)) {
        return Ok(by);
    }
    // Threads that use the enforcer already keep to it.
    if state.chosen != Some(Enforcement::Enforcer) && state.prove(Enforcement::Timer, below)? {
        return Ok(Enforcement::Timer);
    }
    state.prove(Enforcement::Enforcer, below)?;
    Ok(Enforcement::Enforcer)
}

/// Like [`prove_enforcement`], of one kind only: from then on this process enforces budgets in this way.
///
/// # Real-time
/// As [`prove_enforcement`].
///
/// # Errors
/// As [`prove_enforcement`].
pub fn prove_enforcement_by(by: Enforcement, below: u8) -> Result<(), RtError> {
    if STATE.lock().prove(by, below)? { Ok(()) } else { Err(RtError::BudgetNotEnforced { by, below }) }
}

/// Proves that a thread whose budgets are enforced by this kind may get a priority just below this one. The choice for others stays.
fn prove_kept(by: Enforcement, below: u8) -> Result<(), RtError> {
    let mut state = STATE.lock();
    let chosen = state.chosen;
    let is_proven = state.is_proven(by, below) || {
        let proof = state.prove(by, below);
        state.chosen = chosen;
        proof?
    };
    if is_proven { Ok(()) } else { Err(RtError::BudgetNotEnforced { by, below }) }
}

impl BudgetTimer {
    /// Creates the timer of the current thread, which has, or will have, this priority. All timers of the process use one otherwise unused
    /// real-time signal. Proves first that budgets are enforced at this priority: see [`prove_enforcement`].
    ///
    /// # Errors
    /// Those of [`prove_enforcement`]; [`RtError::Kernel`]: no signal is free, no timer can be created, or the thread already has one.
    pub fn new(own: Arc<OwnPriority>) -> Result<BudgetTimer, RtError> {
        let by = prove_enforcement(own.policy().realtime_priority().unwrap_or(1).saturating_add(1))?;
        Self::enforced(own, by)
    }
}

impl OwnPriority {
    /// Gives thread `tid` another priority.
    ///
    /// # Real-time
    /// Not for the changed thread itself, which never waits.
    ///
    /// # Errors
    /// As [`set_policy_of`], and of a thread with a [`BudgetTimer`] as [`prove_enforcement`]; the thread then has its former priority.
    pub fn change(&self, tid: u32, priority: u8) -> Result<(), RtError> {
        self.with(priority).check()?;
        if let Some(by) = self.enforced.get() {
            prove_kept(*by, priority.saturating_add(1))?;
        }
        self.replace(tid, priority)
    }
}

impl State {
    const fn new() -> State {
        State { chosen: None, proven_below: [0; 2], enforcer: None }
    }

    const fn is_proven(&self, by: Enforcement, below: u8) -> bool {
        self.proven_below[by as usize] >= below
    }

    /// Proves one kind of enforcement, and records it. False: a timer did not fire in time.
    fn prove(&mut self, by: Enforcement, below: u8) -> Result<bool, RtError> {
        if by == Enforcement::Enforcer {
            self.outrank(below)?;
        }
        let priority = below.saturating_sub(1).max(1);
        let has_fired = match by {
            Enforcement::Timer => fires(by, priority, TIMER_PATIENCE)?,
            Enforcement::Enforcer => fires(by, priority, ENFORCER_PATIENCE)?,
        };
        match (has_fired, by) {
            (true, _) => {
                self.chosen = Some(by);
                self.proven_below[by as usize] = below.max(self.proven_below[by as usize]);
            }
            (false, Enforcement::Timer) => {}
            (false, Enforcement::Enforcer) => return Err(RtError::BudgetNotEnforced { by, below }),
        }
        Ok(has_fired)
    }

    /// Makes the enforcer run at this priority, or at a higher one.
    fn outrank(&mut self, priority: u8) -> Result<(), RtError> {
        if Policy::Fifo(priority).check().is_err() {
            return Err(RtError::BudgetNotEnforced { by: Enforcement::Enforcer, below: priority });
        }
        let tid = match self.enforcer {
            Some((_, present)) if present >= priority => return Ok(()),
            Some((tid, _)) => {
                set_policy_of(tid, Policy::Fifo(priority))?;
                tid
            }
            None => enforcer::start(priority, budget::signal()?)?,
        };
        self.enforcer = Some((tid, priority));
        Ok(())
    }
}

/// Whether a thread of this priority that never sleeps is demoted before it has used `patience` of processor time.
fn fires(by: Enforcement, priority: u8, patience: Duration) -> Result<bool, RtError> {
    let policy = Policy::Fifo(priority);
    let own = Arc::new(OwnPriority::new(policy));
    let (failure, failed) = std::sync::mpsc::channel();
    let thread = ThreadBuilder::new("budget-proof").policy(policy).spawn(move || {
        let timer = BudgetTimer::enforced(own, by).map_err(|error| failure.send(error)).ok();
        move || {
            let Some(timer) = timer else { return false };
            let since_ns = thread_cpu_ns();
            timer.arm(since_ns, BUDGET);
            let end_ns = since_ns.saturating_add(nanoseconds(patience));
            while !timer.is_demoted() && thread_cpu_ns() < end_ns {
                std::hint::spin_loop();
            }
            timer.disarm_for_good()
        }
    })?;
    let has_fired = thread.join()?;
    failed.try_recv().map_or(Ok(has_fired), Err)
}
