// SPDX-License-Identifier: MIT OR Apache-2.0
//! A budget of processor time that a thread may use at its priority: a thread that uses more is demoted in the middle of its work, or
//! suspended until it gets another budget.
//!
//! ```text
//!  arm(budget)     alarm after `budget` of wall time, which is the least that the processor time can take
//!   signal         has the thread used it? no: alarm for what is left; yes: SCHED_OTHER, below every real-time thread,
//!                  or asleep until the next refill, and alarm for another budget
//!  disarm()        no alarm; if the thread was demoted, its policy again
//! ```
//!
//! The alarm is the kernel's high-resolution timer, and not its processor-time timer, whose ticks are milliseconds. Where that does not
//! reach a busy thread, the [enforcer](crate::enforcer) provides the alarm: see [`prove_enforcement`](crate::prove_enforcement). If others
//! preempt the thread, the timer may fire while budget is left. The thread then gets one more signal each time; the alarm is set for the
//! rest of the budget, or for 50 µs: a demotion is later than the alarm itself by at most that.

use std::cell::Cell;
use std::io;
use std::marker::PhantomData;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering, compiler_fence};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use std::{mem, ptr};

use crate::clock::{nanoseconds, thread_cpu_ns};
use crate::enforcer;
use crate::fork::ProcessMark;
use crate::{Enforcement, OwnPriority, RtError, current_tid};

/// What sends the signal.
#[derive(Clone, Copy)]
enum Alarm {
    None,
    Timer(libc::timer_t),
    Enforcer(&'static enforcer::Alarm),
}

/// The data of the signal handler, in the thread that gets the signal. No other thread accesses it.
struct HandlerState {
    alarm: Cell<Alarm>,
    /// The process in which the alarm was made: a forked child has none.
    process: Cell<Option<ProcessMark>>,
    /// The priority object that must know that the thread is demoted; null: none. Kept alive by the
    /// `BudgetTimer`.
    own: Cell<*const OwnPriority>,
    /// The processor time at which the budget is used up; 0: no budget.
    end_ns: AtomicU64,
    demoted: AtomicBool,
    /// The budget at each refill; 0: the thread is demoted instead.
    refill_ns: AtomicU64,
    /// The time of the next refill.
    refill_at_ns: AtomicU64,
    period_ns: AtomicU64,
    suspended: AtomicBool,
}

impl HandlerState {
    /// Returns the alarm, if it was made in this process. May be called in signal handlers.
    fn alarm(&self) -> Alarm {
        match self.process.get() {
            Some(process) if process.is_here() => self.alarm.get(),
            _ => Alarm::None,
        }
    }
}

thread_local! {
    // Without a destructor, and made before the first signal can come: a handler may use it.
    static STATE: HandlerState = const {
        HandlerState {
            alarm: Cell::new(Alarm::None),
            process: Cell::new(None),
            own: Cell::new(ptr::null()),
            end_ns: AtomicU64::new(0),
            demoted: AtomicBool::new(false),
            refill_ns: AtomicU64::new(0),
            refill_at_ns: AtomicU64::new(0),
            period_ns: AtomicU64::new(0),
            suspended: AtomicBool::new(false),
        }
    };
}

/// The refill of a suspended thread: a thread that has used up its budget sleeps until it gets another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refill {
    /// The time of the refill, in `CLOCK_MONOTONIC` ns.
    pub at_ns: u64,
    /// The time between refills.
    pub period: Duration,
    /// The budget at each refill.
    pub budget: Duration,
}

/// The rest of a budget when it was disarmed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RemainingBudget {
    /// Processor time, in nanoseconds.
    pub budget_ns: u64,
    /// The time of the next refill, in `CLOCK_MONOTONIC` ns.
    pub refill_at_ns: u64,
}

/// Enforces budgets of processor time for the current thread. Each thread has at most one, and creates it
/// itself.
///
/// ```no_run
/// use std::sync::Arc;
/// use std::time::Duration;
/// use tautline_rt::{BudgetTimer, OwnPriority, Policy};
///
/// let timer = BudgetTimer::new(Arc::new(OwnPriority::new(Policy::Fifo(20))))?;
/// timer.arm(tautline_rt::clock::thread_cpu_ns(), Duration::from_millis(1));
/// // ... work at this thread's priority, for a millisecond of processor time; what follows is done below all others ...
/// assert!(!timer.disarm(), "it took less");
/// # Ok::<(), tautline_rt::RtError>(())
/// ```
#[derive(Debug)]
pub struct BudgetTimer {
    own: Arc<OwnPriority>,
    /// Belongs to the thread that created it.
    _thread: PhantomData<*const ()>,
}

impl BudgetTimer {
    /// Creates the timer as [`new`](Self::new) does, but without a proof.
    pub(crate) fn enforced(own: Arc<OwnPriority>, by: Enforcement) -> Result<BudgetTimer, RtError> {
        let signal = signal()?;
        let failed = |what| RtError::Kernel { what, source: io::Error::last_os_error() };
        STATE.with(|state| {
            if !matches!(state.alarm(), Alarm::None) {
                let source = io::Error::from(io::ErrorKind::AlreadyExists);
                return Err(RtError::Kernel { what: "a second budget timer of a thread", source });
            }
            // SAFETY: a set that lives on this stack, filled by these calls; the old mask is not asked for.
            let unblocked = unsafe {
                let mut set = mem::zeroed();
                libc::sigemptyset(&raw mut set);
                libc::sigaddset(&raw mut set, signal);
                libc::pthread_sigmask(libc::SIG_UNBLOCK, &raw const set, ptr::null_mut())
            };
            if unblocked != 0 {
                return Err(failed("pthread_sigmask"));
            }
            let alarm = match by {
                Enforcement::Timer => {
                    Alarm::Timer(create_timer(signal).ok_or_else(|| failed("timer_create"))?)
                }
                Enforcement::Enforcer => Alarm::Enforcer(enforcer::Alarm::take()),
            };
            let _ = own.enforced.set(by);
            // In a forked child these still hold the parent's values.
            state.end_ns.store(0, Ordering::Relaxed);
            state.refill_ns.store(0, Ordering::Relaxed);
            state.demoted.store(false, Ordering::Relaxed);
            state.suspended.store(false, Ordering::Relaxed);
            state.own.set(Arc::as_ptr(&own));
            state.alarm.set(alarm);
            state.process.set(Some(ProcessMark::new()));
            Ok(BudgetTimer { own, _thread: PhantomData })
        })
    }

    /// Enforces `budget`, counted from the processor time `since_ns` of the thread.
    ///
    /// # Real-time
    /// No allocation; no wait; at most one syscall.
    pub fn arm(&self, since_ns: u64, budget: Duration) {
        self.arm_late(since_ns, since_ns, budget);
    }

    /// Like [`arm`](Self::arm), in a thread that has used processor time since then, up to `now_ns`.
    ///
    /// # Real-time
    /// As [`arm`](Self::arm).
    pub fn arm_late(&self, since_ns: u64, now_ns: u64, budget: Duration) {
        STATE.with(|state| state.refill_ns.store(0, Ordering::Relaxed));
        self.start(since_ns, now_ns, nanoseconds(budget));
    }

    /// Like [`arm_late`](Self::arm_late), but when the budget is used up the thread is not demoted: it sleeps, in the middle of its work, until
    /// the refill. It keeps everything that it holds, including the allocator's locks.
    ///
    /// # Real-time
    /// As [`arm`](Self::arm).
    pub fn arm_refilled(&self, since_ns: u64, now_ns: u64, budget_ns: u64, refill: Refill) {
        STATE.with(|state| {
            state.refill_at_ns.store(refill.at_ns, Ordering::Relaxed);
            // Never zero: time has to pass from refill to refill.
            state.period_ns.store(nanoseconds(refill.period).max(1), Ordering::Relaxed);
            state.refill_ns.store(nanoseconds(refill.budget).max(1), Ordering::Relaxed);
        });
        self.start(since_ns, now_ns, budget_ns);
    }

    fn start(&self, since_ns: u64, now_ns: u64, budget_ns: u64) {
        let end_ns = since_ns.saturating_add(budget_ns).max(1);
        STATE.with(|state| {
            state.end_ns.store(end_ns, Ordering::Relaxed);
            compiler_fence(Ordering::SeqCst);
            set(state, end_ns.saturating_sub(now_ns).max(1));
        });
    }

    /// Ends the enforcement of the budget. Returns whether the thread was demoted; if so, it gets its priority
    /// back. If the kernel refuses that, the thread stays demoted, and the next call tries again.
    ///
    /// # Real-time
    /// No allocation; no wait; at most one syscall, one more if it was demoted.
    pub fn disarm(&self) -> bool {
        let demoted = self.disarm_for_good();
        if demoted && self.own.resume() {
            STATE.with(|state| state.demoted.store(false, Ordering::Relaxed));
        }
        demoted
    }

    /// Like [`disarm`](Self::disarm), but a demoted thread stays demoted.
    ///
    /// # Real-time
    /// No allocation; no wait; at most one syscall.
    pub fn disarm_for_good(&self) -> bool {
        STATE.with(|state| {
            state.end_ns.store(0, Ordering::Relaxed);
            compiler_fence(Ordering::SeqCst);
            set(state, 0);
            state.demoted.load(Ordering::Relaxed)
        })
    }

    /// Whether the thread is demoted.
    ///
    /// # Real-time
    /// No allocation; no wait; no syscall.
    pub fn is_demoted(&self) -> bool {
        STATE.with(|state| state.demoted.load(Ordering::Relaxed))
    }

    /// Whether the thread has been suspended since it was armed.
    ///
    /// # Real-time
    /// No allocation; no wait; no syscall.
    pub fn was_suspended(&self) -> bool {
        STATE.with(|state| state.suspended.load(Ordering::Relaxed))
    }

    /// Like [`disarm`](Self::disarm), for a thread that is suspended and not demoted: returns whether it was, up to the last moment, and the
    /// rest of its budget until the next refill.
    ///
    /// # Real-time
    /// No allocation; no wait; at most two syscalls.
    pub fn disarm_refilled(&self) -> (bool, RemainingBudget) {
        STATE.with(|state| {
            let end_ns = state.end_ns.swap(0, Ordering::Relaxed);
            compiler_fence(Ordering::SeqCst);
            set(state, 0);
            let suspended = state.suspended.swap(false, Ordering::Relaxed);
            let budget_ns = end_ns.saturating_sub(thread_cpu_ns());
            let refill_at_ns = state.refill_at_ns.load(Ordering::Relaxed);
            (suspended, RemainingBudget { budget_ns, refill_at_ns })
        })
    }

    /// Demotes the thread until the next [`disarm`](Self::disarm): for work that is too late to run at its priority.
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
            state.own.set(ptr::null());
            compiler_fence(Ordering::SeqCst);
            let alarm = state.alarm();
            state.alarm.set(Alarm::None);
            match alarm {
                Alarm::None => {}
                // SAFETY: made for this thread, and deleted once. A signal that is pending finds no budget.
                Alarm::Timer(timer) => _ = unsafe { libc::timer_delete(timer) },
                Alarm::Enforcer(alarm) => alarm.give_back(),
            }
        });
    }
}

/// A timer that sends the signal to the current thread.
fn create_timer(signal: libc::c_int) -> Option<libc::timer_t> {
    // SAFETY: all-zero bytes are a valid sigevent.
    let mut event: libc::sigevent = unsafe { mem::zeroed() };
    event.sigev_notify = libc::SIGEV_THREAD_ID;
    event.sigev_signo = signal;
    event.sigev_notify_thread_id = current_tid().cast_signed();
    let mut timer = ptr::null_mut();
    // SAFETY: both point to values that outlive the call.
    let made = unsafe { libc::timer_create(libc::CLOCK_MONOTONIC, &raw mut event, &raw mut timer) };
    (made == 0).then_some(timer)
}

/// Sets the alarm to go off once, `after_ns` from now, which is when the budget may be used up; 0: never.
fn set(state: &HandlerState, after_ns: u64) {
    let timer = match state.alarm() {
        Alarm::None => return,
        Alarm::Enforcer(alarm) if after_ns == 0 => return alarm.clear(),
        Alarm::Enforcer(alarm) => return alarm.set(after_ns, state.end_ns.load(Ordering::Relaxed)),
        Alarm::Timer(timer) => timer,
    };
    let at = libc::timespec {
        tv_sec: (after_ns / 1_000_000_000).cast_signed(),
        tv_nsec: (after_ns % 1_000_000_000).cast_signed(),
    };
    let once = libc::itimerspec { it_interval: libc::timespec { tv_sec: 0, tv_nsec: 0 }, it_value: at };
    // SAFETY: the thread's timer, which lives; `once` outlives the call. Allowed in a signal handler (POSIX.1).
    unsafe { libc::timer_settime(timer, 0, &raw const once, ptr::null_mut()) };
}

fn demote(state: &HandlerState) {
    // SAFETY: `BudgetTimer` sets it to an object that it keeps alive, and to null before it releases that object, in this thread.
    let Some(own) = (unsafe { state.own.get().as_ref() }) else { return };
    if own.lower() {
        state.demoted.store(true, Ordering::Relaxed);
    }
}

/// Sleeps until the next refill, in the signal handler. The code that sets the time of the refill bounds the sleep.
fn suspend(state: &HandlerState, budget_ns: u64) {
    state.suspended.store(true, Ordering::Relaxed);
    let at_ns = state.refill_at_ns.load(Ordering::Relaxed);
    let at = libc::timespec {
        tv_sec: (at_ns / 1_000_000_000).cast_signed(),
        tv_nsec: (at_ns % 1_000_000_000).cast_signed(),
    };
    loop {
        // SAFETY: `at` outlives the call, which only reads it; a bare system call may be made in a handler.
        let answer = unsafe {
            let nothing = ptr::null_mut::<libc::timespec>();
            libc::syscall(
                libc::SYS_clock_nanosleep,
                libc::CLOCK_MONOTONIC,
                libc::TIMER_ABSTIME,
                &raw const at,
                nothing,
            )
        };
        // SAFETY: this thread's own errno.
        if answer == 0 || unsafe { *libc::__errno_location() } != libc::EINTR {
            break;
        }
    }
    let next_ns = at_ns.saturating_add(state.period_ns.load(Ordering::Relaxed));
    state.refill_at_ns.store(next_ns, Ordering::Relaxed);
    state.end_ns.store(thread_cpu_ns().saturating_add(budget_ns), Ordering::Relaxed);
    set(state, budget_ns);
}

/// Returns the signal of the process's budget timers, with its handler installed.
pub(crate) fn signal() -> Result<libc::c_int, RtError> {
    static SIGNAL: OnceLock<Option<libc::c_int>> = OnceLock::new();
    let none = || RtError::Kernel {
        what: "a budget timer needs a real-time signal, all of which have handlers: sigaction",
        source: io::Error::from(io::ErrorKind::AddrInUse),
    };
    SIGNAL
        .get_or_init(|| (libc::SIGRTMIN() + 1..=libc::SIGRTMAX()).rev().find(|signal| claim(*signal)))
        .ok_or_else(none)
}

/// Installs the handler for a signal that has none; returns whether it did.
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

/// The signal handler: the alarm went off. Runs in the thread that has the budget.
extern "C" fn fired(_: libc::c_int) {
    // SAFETY: each thread has its own errno, which is to be as the interrupted code left it.
    let errno = unsafe { *libc::__errno_location() };
    let _ = STATE.try_with(|state| {
        let end_ns = state.end_ns.load(Ordering::Relaxed);
        if end_ns == 0 {
            return;
        }
        match end_ns.saturating_sub(thread_cpu_ns()) {
            0 => match state.refill_ns.load(Ordering::Relaxed) {
                0 => {
                    state.end_ns.store(0, Ordering::Relaxed);
                    demote(state);
                }
                budget_ns => suspend(state, budget_ns),
            },
            left_ns => {
                // The processor time of this handler is not charged to the job.
                state.end_ns.store(thread_cpu_ns().saturating_add(left_ns), Ordering::Relaxed);
                set(state, left_ns.max(enforcer::LEAST_LOOK_NS));
            }
        }
    });
    // SAFETY: as above.
    unsafe { *libc::__errno_location() = errno };
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::{burn_cpu, monotonic_ns, sleep_until_monotonic, test_time};
    use crate::permission::{realtime_permitted, test_needs};
    use crate::{Policy, Realtime, ThreadBuilder, current_policy, prove_enforcement_by};
    use rustix::process::{Resource, getrlimit};
    use rustix::thread::{CapabilitySet, capabilities, set_capabilities};
    use std::sync::{Mutex, MutexGuard, PoisonError};

    const PRIORITY: u8 = 10;

    /// With each kind of enforcement, on a thread of its own.
    fn on_threads(run: fn(BudgetTimer, Arc<OwnPriority>)) {
        let Some(_alone) = permitted() else { return };
        for by in [Enforcement::Timer, Enforcement::Enforcer] {
            match prove_enforcement_by(by, PRIORITY + 10) {
                Err(error) if by == Enforcement::Timer => {
                    println!("skipped: {error}");
                    continue;
                }
                proven => proven.unwrap(),
            }
            let thread =
                ThreadBuilder::new("budget").policy(Policy::Fifo(PRIORITY)).realtime(Realtime::Required);
            let body = move || {
                let own = own();
                run(BudgetTimer::new(Arc::clone(&own)).unwrap(), own);
            };
            thread.spawn(move || body).unwrap().join().unwrap();
        }
    }

    fn ms(time: u64) -> Duration {
        test_time(Duration::from_millis(time))
    }

    /// How late a timer comes is for a quiet machine: here it comes.
    fn burn_until_demoted(timer: &BudgetTimer) {
        let end_ns = thread_cpu_ns() + 2_000_000_000;
        while !timer.is_demoted() && thread_cpu_ns() < end_ns {
            std::hint::spin_loop();
        }
    }

    fn ns(time: u64) -> u64 {
        crate::clock::nanoseconds(ms(time))
    }

    fn own() -> Arc<OwnPriority> {
        Arc::new(OwnPriority::new(Policy::Fifo(PRIORITY)))
    }

    /// To one test at a time: how budgets are enforced is the process's.
    fn permitted() -> Option<MutexGuard<'static, ()>> {
        static ALONE: Mutex<()> = Mutex::new(());
        let permitted = test_needs(realtime_permitted(10));
        permitted.map(|()| ALONE.lock().unwrap_or_else(PoisonError::into_inner))
    }

    #[test]
    fn who_uses_more_is_demoted_until_it_is_disarmed() {
        on_threads(|timer, _| {
            let policy = Policy::Fifo(PRIORITY);
            assert!(BudgetTimer::new(own()).is_err(), "one for a thread");
            for round in 0..20 {
                timer.arm(thread_cpu_ns(), ms(2));
                burn_cpu(ms(1));
                assert_eq!(current_policy().unwrap(), policy, "{round}");
                burn_until_demoted(&timer);
                assert_eq!(current_policy().unwrap(), Policy::Other { nice: 0 }, "{round}");
                assert!(timer.disarm());
                assert_eq!(current_policy().unwrap(), policy, "{round}");
            }
            timer.arm(thread_cpu_ns(), ms(2));
            assert!(!timer.disarm());
            burn_cpu(ms(3));
            assert_eq!(current_policy().unwrap(), policy, "nothing is held to");
            timer.demote();
            assert_eq!(current_policy().unwrap(), Policy::Other { nice: 0 });
            assert!(timer.disarm() && current_policy().unwrap() == policy);
            drop(timer);
            assert!(BudgetTimer::new(own()).is_ok());
        });
    }

    /// As of a program that gives up its privilege after its start.
    #[test]
    fn who_does_not_get_its_priority_back_stays_demoted() {
        on_threads(|timer, own| {
            let sets = capabilities(None).unwrap();
            if getrlimit(Resource::Rtprio).current != Some(0) {
                return println!("skipped: without the privilege there is still a limit to use");
            }
            timer.demote();
            let mut fewer = sets;
            fewer.effective.remove(CapabilitySet::SYS_NICE);
            set_capabilities(None, fewer).unwrap();
            for _ in 0..2 {
                assert!(timer.disarm() && timer.is_demoted(), "told for each job");
                assert_eq!(current_policy().unwrap(), Policy::Other { nice: 0 });
            }
            set_capabilities(None, sets).unwrap();
            assert!(timer.disarm() && !timer.is_demoted());
            assert_eq!(current_policy().unwrap(), own.policy());
        });
    }

    /// The enforcer falls asleep while the next budget is armed, at any instant of that.
    #[test]
    fn no_budget_is_passed_over() {
        on_threads(|timer, _| {
            for round in 0..1_000 {
                timer.arm(thread_cpu_ns(), Duration::from_micros(20 + round % 50));
                burn_until_demoted(&timer);
                assert!(timer.disarm(), "{round}");
                for _ in 0..round % 7 {
                    timer.arm(thread_cpu_ns(), Duration::from_millis(100));
                    assert!(!timer.disarm());
                }
            }
        });
    }

    #[test]
    fn a_priority_that_others_change_is_what_a_demoted_thread_gets_back() {
        on_threads(|timer, own| {
            let tid = current_tid();
            // As if a thread above needed it: this one keeps to what it has.
            prove_enforcement_by(Enforcement::Enforcer, PRIORITY + 10).unwrap();
            own.change(tid, 12).unwrap();
            assert_eq!(current_policy().unwrap(), Policy::Fifo(12));
            timer.demote();
            own.change(tid, 14).unwrap();
            assert_eq!(current_policy().unwrap(), Policy::Other { nice: 0 }, "it stays demoted");
            assert!(timer.disarm());
            assert_eq!((current_policy().unwrap(), own.policy()), (Policy::Fifo(14), Policy::Fifo(14)));
            assert!(own.change(tid, 0).is_err() && own.policy() == Policy::Fifo(14));
        });
    }

    /// Whoever changes it does not lift a demotion, and what is demoted does not keep the old priority.
    #[test]
    fn changes_and_demotions_at_once_end_with_the_last_priority() {
        on_threads(|timer, own| {
            let tid = current_tid();
            std::thread::scope(|scope| {
                let changes =
                    scope.spawn(|| (0..2_000).for_each(|n| own.change(tid, 10 + (n % 3) as u8).unwrap()));
                while !changes.is_finished() {
                    timer.demote();
                    // The other one may be about to lift it, but not for long: it looks again.
                    burn_cpu(Duration::from_micros(20));
                    assert!(timer.disarm());
                }
            });
            assert_eq!(current_policy().unwrap(), own.policy());
        });
    }

    #[test]
    fn who_is_suspended_gets_no_more_than_its_refills() {
        on_threads(|timer, _| {
            let (period, budget) = (ms(20), ms(2));
            let begin_ns = monotonic_ns();
            let refill = Refill { at_ns: begin_ns + ns(20), period, budget };
            let now_ns = thread_cpu_ns();
            timer.arm_refilled(now_ns, now_ns, ns(2), refill);
            assert!(!timer.was_suspended());
            burn_cpu(ms(7));
            // Three refills were needed: 2 ms at once, and after 20, 40 and 60 ms.
            let taken_ns = monotonic_ns() - begin_ns;
            assert!(taken_ns >= ns(60), "{taken_ns}");
            assert!(timer.was_suspended());
            let (suspended, RemainingBudget { budget_ns, refill_at_ns }) = timer.disarm_refilled();
            // A thread that got the processor late may have missed the time of one.
            assert!((refill_at_ns - begin_ns).is_multiple_of(ns(20)) && refill_at_ns >= begin_ns + ns(80));
            assert!(suspended && budget_ns < ns(2) && !timer.was_suspended());
            burn_cpu(ms(3));
            assert!(!timer.disarm_refilled().0, "nothing is held to");
        });
    }

    #[test]
    fn time_that_others_use_is_not_counted() {
        on_threads(|timer, _| {
            timer.arm(thread_cpu_ns(), ms(5));
            // Five times the budget on the clock, and none of it on the processor.
            sleep_until_monotonic(monotonic_ns() + ns(25));
            assert!(!timer.disarm());
            // A signal comes all the same, and the rest of the budget is still held.
            timer.arm(thread_cpu_ns(), ms(5));
            sleep_until_monotonic(monotonic_ns() + ns(10));
            burn_cpu(ms(6));
            assert!(timer.disarm());
        });
    }

    #[test]
    fn the_enforcer_stops_a_thread_on_whichever_core_it_runs() {
        let Some(_alone) = permitted() else { return };
        prove_enforcement_by(Enforcement::Enforcer, PRIORITY + 1).unwrap();
        for core in crate::CoreSet::allowed().unwrap().iter() {
            let thread = ThreadBuilder::new("budget").policy(Policy::Fifo(PRIORITY));
            let body = || {
                let timer = BudgetTimer::new(own()).unwrap();
                timer.arm(thread_cpu_ns(), Duration::from_micros(500));
                // For ever, if it is not stopped.
                while !timer.is_demoted() {
                    std::hint::spin_loop();
                }
                assert_eq!(current_policy().unwrap().realtime_priority(), None);
            };
            thread.cores(crate::CoreSet::one(core)).spawn(move || body).unwrap().join().unwrap();
        }
    }

    #[test]
    fn what_was_used_before_is_part_of_the_budget() {
        on_threads(|timer, _| {
            let since_ns = thread_cpu_ns();
            burn_cpu(ms(50));
            timer.arm_late(since_ns, thread_cpu_ns(), ms(60));
            burn_until_demoted(&timer);
            let used_ns = thread_cpu_ns() - since_ns;
            assert!(timer.disarm());
            assert!((ns(60)..ns(110)).contains(&used_ns), "{used_ns} ns");
        });
    }

    #[test]
    fn the_enforcer_keeps_above_those_that_it_stops() {
        let Some(_alone) = permitted() else { return };
        prove_enforcement_by(Enforcement::Enforcer, PRIORITY + 1).unwrap();
        let priority = || {
            let thread = crate::threads().unwrap().into_iter().find(|thread| thread.name == "enforcer");
            let Some(Policy::Fifo(priority)) = thread.map(|thread| thread.policy) else {
                panic!("no enforcer")
            };
            priority
        };
        let first = priority();
        assert!(first > PRIORITY);
        let thread = ThreadBuilder::new("budget").policy(Policy::Fifo(PRIORITY));
        let body = move || {
            let own = own();
            let _timer = BudgetTimer::new(Arc::clone(&own)).unwrap();
            own.change(current_tid(), first + 4).unwrap();
            assert_eq!(priority(), first + 5);
            let error = own.change(current_tid(), 99).unwrap_err();
            assert!(matches!(error, RtError::BudgetNotEnforced { below: 100, .. }), "{error}");
            assert_eq!(own.policy(), Policy::Fifo(first + 4));
        };
        thread.spawn(move || body).unwrap().join().unwrap();
    }
}
