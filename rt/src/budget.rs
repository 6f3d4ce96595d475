// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processor time that a thread may use at its priority, held by a timer: who uses more is demoted in the midst of its work.
//!
//! ```text
//!  arm(budget)     timer for `budget` of wall time, which is the least that the processor time can take
//!   signal         has the thread used it? no: timer for what is left; yes: SCHED_OTHER, below every real-time thread
//!  disarm()        no timer; if the thread was demoted, its policy again
//! ```
//!
//! The timer is the kernel's high-resolution one, not that of processor time, which ticks in milliseconds. A thread that others
//! preempt gets one signal more for each time that the timer finds it with time left, which is never longer than what it is left.

use std::cell::Cell;
use std::io;
use std::marker::PhantomData;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering, compiler_fence};
use std::time::Duration;
use std::{mem, ptr};

use crate::clock::{nanoseconds, thread_cpu_ns};
use crate::{Policy, RtError, current_tid};

/// What the signal finds, in the thread that it comes to. Nobody else touches it.
struct State {
    timer: Cell<libc::timer_t>,
    /// Processor time at which the budget is used up; 0: none is held.
    end_ns: AtomicU64,
    demoted: AtomicBool,
}

thread_local! {
    // Without a destructor, and made before the first signal can come: a handler may use it.
    static STATE: State = const {
        State { timer: Cell::new(ptr::null_mut()), end_ns: AtomicU64::new(0), demoted: AtomicBool::new(false) }
    };
}

/// Holds the current thread to budgets of processor time. One for a thread, made by itself.
///
/// ```
/// use std::time::Duration;
/// use tautline_rt::{BudgetTimer, Policy};
///
/// let timer = BudgetTimer::new()?;
/// timer.arm(tautline_rt::clock::thread_cpu_ns(), Duration::from_millis(1));
/// // ... work at this thread's priority, for a millisecond of processor time; what follows is done below all others ...
/// assert!(!timer.disarm(Policy::Other { nice: 0 }), "it took less");
/// # Ok::<(), tautline_rt::RtError>(())
/// ```
#[derive(Debug)]
pub struct BudgetTimer {
    /// Of the thread that made it.
    _thread: PhantomData<*const ()>,
}

impl BudgetTimer {
    /// Makes the thread's timer. Takes one real-time signal of the process that nobody else uses, for all timers.
    ///
    /// # Errors
    /// [`RtError::Kernel`]: no signal is free, no timer can be made, or the thread has one.
    pub fn new() -> Result<BudgetTimer, RtError> {
        let signal = signal()?;
        let failed = |what| RtError::Kernel { what, source: io::Error::last_os_error() };
        STATE.with(|state| {
            if !state.timer.get().is_null() {
                let source = io::Error::from(io::ErrorKind::AlreadyExists);
                return Err(RtError::Kernel { what: "a second budget timer of a thread", source });
            }
            // SAFETY: all-zero bytes are a valid sigevent.
            let mut event: libc::sigevent = unsafe { mem::zeroed() };
            event.sigev_notify = libc::SIGEV_THREAD_ID;
            event.sigev_signo = signal;
            event.sigev_notify_thread_id = current_tid().cast_signed();
            let mut timer = ptr::null_mut();
            // SAFETY: both point to values that outlive the call.
            if unsafe { libc::timer_create(libc::CLOCK_MONOTONIC, &raw mut event, &raw mut timer) } != 0 {
                return Err(failed("timer_create"));
            }
            // SAFETY: a set that lives on this stack, filled by these calls; the old mask is not asked for.
            let unblocked = unsafe {
                let mut set = mem::zeroed();
                libc::sigemptyset(&raw mut set);
                libc::sigaddset(&raw mut set, signal);
                libc::pthread_sigmask(libc::SIG_UNBLOCK, &raw const set, ptr::null_mut())
            };
            if unblocked != 0 {
                // SAFETY: the timer was made above and is known to nobody.
                unsafe { libc::timer_delete(timer) };
                return Err(failed("pthread_sigmask"));
            }
            // The kernel numbers timers from 0, which glibc hands out as it is.
            state.timer.set(mark(timer));
            Ok(BudgetTimer { _thread: PhantomData })
        })
    }

    /// Holds the thread to `budget` of processor time, counted from when it had used `since_ns`.
    ///
    /// # Real-time
    /// No allocation; no wait; one syscall.
    pub fn arm(&self, since_ns: u64, budget: Duration) {
        let budget_ns = nanoseconds(budget).max(1);
        STATE.with(|state| {
            state.end_ns.store(since_ns.saturating_add(budget_ns).max(1), Ordering::Relaxed);
            compiler_fence(Ordering::SeqCst);
            set(state, budget_ns);
        });
    }

    /// Has no budget to hold any more. Says whether the thread was demoted, and if so gives it `policy` again.
    ///
    /// # Real-time
    /// No allocation; no wait; one syscall, one more if it was demoted.
    pub fn disarm(&self, policy: Policy) -> bool {
        STATE.with(|state| {
            state.end_ns.store(0, Ordering::Relaxed);
            compiler_fence(Ordering::SeqCst);
            set(state, 0);
            let demoted = state.demoted.load(Ordering::Relaxed);
            if demoted && schedule(policy) {
                state.demoted.store(false, Ordering::Relaxed);
            }
            demoted
        })
    }

    /// Demotes the thread until the next [`disarm`](Self::disarm): for work that comes too late to be done at its priority.
    ///
    /// # Real-time
    /// No allocation; no wait; one syscall.
    pub fn demote(&self) {
        STATE.with(demote);
    }
}

impl Drop for BudgetTimer {
    fn drop(&mut self) {
        STATE.with(|state| {
            state.end_ns.store(0, Ordering::Relaxed);
            compiler_fence(Ordering::SeqCst);
            // SAFETY: made by `new` in this thread, and deleted once: the mark is taken away. A signal that is pending finds no budget.
            unsafe { libc::timer_delete(unmark(state.timer.replace(ptr::null_mut()))) };
        });
    }
}

/// A timer as it is kept: null is none.
fn mark(timer: libc::timer_t) -> libc::timer_t {
    ptr::without_provenance_mut(timer.addr().wrapping_add(1))
}

fn unmark(timer: libc::timer_t) -> libc::timer_t {
    ptr::without_provenance_mut(timer.addr().wrapping_sub(1))
}

/// Lets the timer expire once, so much later; 0: never.
fn set(state: &State, after_ns: u64) {
    let timer = state.timer.get();
    if timer.is_null() {
        return;
    }
    let at = libc::timespec {
        tv_sec: (after_ns / 1_000_000_000).cast_signed(),
        tv_nsec: (after_ns % 1_000_000_000).cast_signed(),
    };
    let once = libc::itimerspec { it_interval: libc::timespec { tv_sec: 0, tv_nsec: 0 }, it_value: at };
    // SAFETY: the thread's timer, which lives; `once` outlives the call. Allowed in a signal handler (POSIX.1).
    unsafe { libc::timer_settime(unmark(timer), 0, &raw const once, ptr::null_mut()) };
}

fn demote(state: &State) {
    if schedule(Policy::Other { nice: 0 }) {
        state.demoted.store(true, Ordering::Relaxed);
    }
}

/// Sets the policy of this thread, by the bare system call: for a signal handler.
fn schedule(policy: Policy) -> bool {
    let (class, priority) = match policy {
        Policy::Fifo(priority) => (libc::SCHED_FIFO, priority),
        Policy::RoundRobin(priority) => (libc::SCHED_RR, priority),
        _ => (libc::SCHED_OTHER, 0),
    };
    let param = libc::sched_param { sched_priority: priority.into() };
    // SAFETY: `param` outlives the call; 0 is the calling thread.
    unsafe { libc::syscall(libc::SYS_sched_setscheduler, 0, class, &raw const param) == 0 }
}

/// The process's signal for this, with its handler.
fn signal() -> Result<libc::c_int, RtError> {
    static SIGNAL: OnceLock<Option<libc::c_int>> = OnceLock::new();
    let none = || RtError::Kernel {
        what: "a budget timer needs a real-time signal, all of which have handlers: sigaction",
        source: io::Error::from(io::ErrorKind::AddrInUse),
    };
    SIGNAL
        .get_or_init(|| (libc::SIGRTMIN() + 1..=libc::SIGRTMAX()).rev().find(|signal| claim(*signal)))
        .ok_or_else(none)
}

/// Takes a signal that has no handler.
fn claim(signal: libc::c_int) -> bool {
    // SAFETY: zeroed sigactions are valid; all pointers outlive the calls; the handler may be called at any time.
    unsafe {
        let mut before: libc::sigaction = mem::zeroed();
        if libc::sigaction(signal, ptr::null(), &raw mut before) != 0 || before.sa_sigaction != libc::SIG_DFL
        {
            return false;
        }
        let mut action: libc::sigaction = mem::zeroed();
        action.sa_sigaction = fired as *const () as usize;
        action.sa_flags = libc::SA_RESTART;
        libc::sigemptyset(&raw mut action.sa_mask);
        libc::sigaction(signal, &raw const action, ptr::null_mut()) == 0
    }
}

/// The timer has expired, in the thread that it is for.
extern "C" fn fired(_: libc::c_int) {
    // SAFETY: each thread has its own errno, which is to be as the interrupted code left it.
    let errno = unsafe { *libc::__errno_location() };
    let _ = STATE.try_with(|state| {
        let end_ns = state.end_ns.load(Ordering::Relaxed);
        if end_ns == 0 {
            return;
        }
        match end_ns.saturating_sub(thread_cpu_ns()) {
            0 => {
                state.end_ns.store(0, Ordering::Relaxed);
                demote(state);
            }
            left_ns => set(state, left_ns),
        }
    });
    // SAFETY: as above.
    unsafe { *libc::__errno_location() = errno };
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::{burn_cpu, monotonic_ns, sleep_until_monotonic};
    use crate::permission::realtime_permitted;
    use crate::{Realtime, ThreadBuilder, current_policy};

    fn on_a_thread(policy: Policy, realtime: Realtime, run: fn()) {
        let thread = ThreadBuilder::new("budget").policy(policy).realtime(realtime);
        thread.spawn(move || run).unwrap().join().unwrap();
    }

    fn permitted() -> bool {
        match realtime_permitted(10) {
            Ok(()) => true,
            Err(error) if std::env::var_os("CI").is_some() => panic!("{error}"),
            Err(error) => {
                println!("skipped: {error}");
                false
            }
        }
    }

    #[test]
    fn who_uses_more_is_demoted_until_it_is_disarmed() {
        if !permitted() {
            return;
        }
        on_a_thread(Policy::Fifo(10), Realtime::Required, || {
            let (timer, policy) = (BudgetTimer::new().unwrap(), Policy::Fifo(10));
            assert!(BudgetTimer::new().is_err(), "one for a thread");
            for round in 0..20 {
                timer.arm(thread_cpu_ns(), Duration::from_millis(2));
                burn_cpu(Duration::from_millis(1));
                assert_eq!(current_policy().unwrap(), policy, "{round}");
                burn_cpu(Duration::from_millis(2));
                assert_eq!(current_policy().unwrap(), Policy::Other { nice: 0 }, "{round}");
                assert!(timer.disarm(policy));
                assert_eq!(current_policy().unwrap(), policy, "{round}");
            }
            timer.arm(thread_cpu_ns(), Duration::from_millis(2));
            assert!(!timer.disarm(policy));
            burn_cpu(Duration::from_millis(3));
            assert_eq!(current_policy().unwrap(), policy, "nothing is held to");
            timer.demote();
            assert_eq!(current_policy().unwrap(), Policy::Other { nice: 0 });
            assert!(timer.disarm(policy) && current_policy().unwrap() == policy);
            drop(timer);
            assert!(BudgetTimer::new().is_ok());
        });
    }

    #[test]
    fn time_that_others_use_is_not_counted() {
        on_a_thread(Policy::Other { nice: 0 }, Realtime::Off, || {
            let timer = BudgetTimer::new().unwrap();
            timer.arm(thread_cpu_ns(), Duration::from_millis(5));
            // Five times the budget on the clock, and none of it on the processor.
            sleep_until_monotonic(monotonic_ns() + 25_000_000);
            assert!(!timer.disarm(Policy::Other { nice: 0 }));
            // A signal comes all the same, and the rest of the budget is still held.
            timer.arm(thread_cpu_ns(), Duration::from_millis(5));
            sleep_until_monotonic(monotonic_ns() + 10_000_000);
            burn_cpu(Duration::from_millis(6));
            assert!(timer.disarm(Policy::Other { nice: 0 }));
        });
    }
}
