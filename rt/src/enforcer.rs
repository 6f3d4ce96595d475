// SPDX-License-Identifier: MIT OR Apache-2.0
//! The enforcer: a thread of the process that outranks the threads whose budgets it enforces, and signals those that have used them.
//!
//! It is for kernels on which no timer reaches a busy real-time thread. With PREEMPT_RT, timers expire in a thread of the kernel
//! (`ktimers/N`, `SCHED_FIFO` 1), below every thread that has a budget; only the sleep of a real-time thread ends in the interrupt.
//!
//! ```text
//!  a thread arms   alarm.due = now + budget; if the enforcer sleeps longer than until then: wake it
//!  the enforcer    wakes_at = the earliest due of all alarms; looks again, since one may have been armed meanwhile; sleeps until then
//!  an alarm is due has its thread used the budget? no: due = now + what is left, or 50 µs; yes: the signal, until it can be sent
//!  it disarms      alarm.due = never; the enforcer is not told, and finds nothing when it wakes
//! ```
//!
//! So jobs that end within their budgets make a system call only if the enforcer sleeps too long.

use std::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, AtomicU64, Ordering};

use crate::clock::{monotonic_ns, thread_cpu_ns_of};
use crate::futex::kernel::FutexWord;
use crate::{CoreSet, Policy, RtError, ThreadBuilder};

const NEVER: u64 = u64::MAX;
/// The least time between two checks of a thread: while the thread waits, its budget does not change, and each check costs time.
pub(crate) const LEAST_LOOK_NS: u64 = 50_000;

/// The alarm of one thread. It is never freed: a thread that no longer needs it gives it to another.
#[derive(Debug)]
pub(crate) struct Alarm {
    /// When the enforcer checks the thread, in `CLOCK_MONOTONIC` ns.
    due_ns: AtomicU64,
    /// The processor time of the thread at which its budget is used up.
    end_ns: AtomicU64,
    tid: AtomicU32,
    is_taken: AtomicBool,
    next: AtomicPtr<Alarm>,
}

/// The alarms of the process, newest first.
static ALARMS: AtomicPtr<Alarm> = AtomicPtr::new(std::ptr::null_mut());
/// When the enforcer wakes by itself.
static WAKES_AT: AtomicU64 = AtomicU64::new(NEVER);
/// Changes when the enforcer has to check before that.
static CALLS: FutexWord = FutexWord::new(0);

fn alarms() -> impl Iterator<Item = &'static Alarm> {
    let at = |alarm: &AtomicPtr<Alarm>| {
        // SAFETY: null, or an alarm that `take` has leaked; Acquire pairs with the Release there.
        unsafe { alarm.load(Ordering::Acquire).as_ref() }
    };
    std::iter::successors(at(&ALARMS), move |alarm| at(&alarm.next))
}

impl Alarm {
    /// An alarm for the current thread.
    pub(crate) fn take() -> &'static Alarm {
        let free = |alarm: &&Alarm| {
            alarm.is_taken.compare_exchange(false, true, Ordering::AcqRel, Ordering::Relaxed).is_ok()
        };
        let alarm = alarms().find(free).unwrap_or_else(|| {
            let (due_ns, end_ns, tid) = (AtomicU64::new(NEVER), AtomicU64::new(0), AtomicU32::new(0));
            let alarm: &Alarm = Box::leak(Box::new(Alarm {
                due_ns,
                end_ns,
                tid,
                is_taken: AtomicBool::new(true),
                next: AtomicPtr::default(),
            }));
            let pointer = std::ptr::from_ref(alarm).cast_mut();
            let _ = ALARMS.fetch_update(Ordering::Release, Ordering::Relaxed, |first| {
                alarm.next.store(first, Ordering::Relaxed);
                Some(pointer)
            });
            alarm
        });
        alarm.tid.store(crate::current_tid(), Ordering::Relaxed);
        alarm
    }

    pub(crate) fn give_back(&self) {
        self.clear();
        self.is_taken.store(false, Ordering::Release);
    }

    /// Signals the thread `after_ns` from now, or later, when it has used `end_ns` of processor time. Also for signal handlers.
    pub(crate) fn set(&self, after_ns: u64, end_ns: u64) {
        let due_ns = monotonic_ns().saturating_add(after_ns).min(NEVER - 1);
        self.end_ns.store(end_ns, Ordering::Relaxed);
        // Either this load sees that the enforcer is about to sleep too long, or the enforcer sees the store: both are SeqCst, as there.
        self.due_ns.store(due_ns, Ordering::SeqCst);
        if WAKES_AT.load(Ordering::SeqCst) > due_ns {
            CALLS.0.fetch_add(1, Ordering::SeqCst);
            CALLS.wake();
        }
    }

    pub(crate) fn clear(&self) {
        self.due_ns.store(NEVER, Ordering::Release);
    }

    /// Signals the thread if the alarm is due and the budget is used up. Returns when it is due next, in `CLOCK_MONOTONIC` ns.
    fn check(&self, signal: libc::c_int) -> u64 {
        let (due_ns, now_ns) = (self.due_ns.load(Ordering::SeqCst), monotonic_ns());
        if due_ns > now_ns {
            return due_ns;
        }
        let tid = self.tid.load(Ordering::Relaxed);
        let left_ns = self.end_ns.load(Ordering::Relaxed).saturating_sub(thread_cpu_ns_of(tid));
        let next_ns = if left_ns == 0 { NEVER } else { now_ns.saturating_add(left_ns.max(LEAST_LOOK_NS)) };
        // Only if the alarm is still that of the same job.
        match self.due_ns.compare_exchange(due_ns, next_ns, Ordering::SeqCst, Ordering::SeqCst) {
            Ok(_) if left_ns == 0 && !send(signal, tid) => {
                let again_ns = now_ns.saturating_add(LEAST_LOOK_NS);
                // Unless its thread has set it for another job. One that has cleared it gets a signal, and finds no budget.
                match self.due_ns.compare_exchange(NEVER, again_ns, Ordering::SeqCst, Ordering::SeqCst) {
                    Ok(_) => again_ns,
                    Err(present_ns) => present_ns,
                }
            }
            Ok(_) => next_ns,
            Err(present_ns) => present_ns,
        }
    }
}

/// Sends the signal to a thread of this process. False: too many signals of this user are pending (`RLIMIT_SIGPENDING`), so it has to be
/// sent again.
fn send(signal: libc::c_int, tid: u32) -> bool {
    // SAFETY: no memory is passed. A thread that has ended, or another one with its number, has no budget.
    let sent = unsafe { libc::syscall(libc::SYS_tgkill, libc::getpid(), tid, signal) };
    sent == 0 || std::io::Error::last_os_error().raw_os_error() != Some(libc::EAGAIN)
}

/// Starts the enforcer, which never ends. Returns the id of its thread.
///
/// It may run on every core that the process may use: the kernel moves it to one where a lower priority runs.
pub(crate) fn start(priority: u8, signal: libc::c_int) -> Result<u32, RtError> {
    // In a forked child these still hold the parent's values.
    WAKES_AT.store(NEVER, Ordering::SeqCst);
    alarms().for_each(Alarm::clear);
    let thread = ThreadBuilder::new("enforcer")
        .policy(Policy::Fifo(priority))
        .cores(CoreSet::allowed()?)
        .stack_bytes(64 * 1024);
    Ok(thread.spawn(move || move || run(signal))?.info().tid)
}

fn run(signal: libc::c_int) {
    loop {
        let seen = CALLS.0.load(Ordering::SeqCst);
        let look = || alarms().map(|alarm| alarm.check(signal)).min().unwrap_or(NEVER);
        let next_ns = look();
        WAKES_AT.store(next_ns, Ordering::SeqCst);
        if look() >= next_ns {
            CALLS.wait(seen, (next_ns != NEVER).then_some(next_ns));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::thread_cpu_ns;
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

    /// While a thread waits with little of its budget left, this stays so little.
    #[test]
    fn a_thread_with_little_left_is_not_looked_at_all_the_time() {
        let alarm = Alarm::take();
        let look = || {
            let begun_ns = monotonic_ns();
            alarm.set(0, thread_cpu_ns() + 20_000);
            (begun_ns, alarm.check(0))
        };
        // Unless this took longer than what was left.
        let found = std::iter::repeat_with(look).take(10_000).find(|(_, next_ns)| *next_ns != NEVER);
        alarm.give_back();
        let Some((begun_ns, next_ns)) = found else { return println!("skipped: this machine is too slow") };
        assert!(next_ns >= begun_ns + LEAST_LOOK_NS, "{}", next_ns - begun_ns);
    }

    /// The signals of all processes of a user count. Runs itself again, because the limit is the process's.
    #[test]
    fn a_signal_that_cannot_be_sent_is_sent_again() {
        const CHILD: &str = "TAUTLINE_NO_SIGNALS";
        if std::env::var_os(CHILD).is_none() {
            let mut child = std::process::Command::new(std::env::current_exe().unwrap());
            let name = "enforcer::tests::a_signal_that_cannot_be_sent_is_sent_again";
            assert!(child.args(["--exact", name]).env(CHILD, "1").status().unwrap().success());
            return;
        }
        let (signal, alarm) = (crate::budget::signal().unwrap(), Alarm::take());
        let limit = getrlimit(Resource::Sigpending);
        setrlimit(Resource::Sigpending, Rlimit { current: Some(0), ..limit }).unwrap();
        alarm.set(0, 0);
        let next_ns = alarm.check(signal);
        assert_ne!(next_ns, NEVER);
        setrlimit(Resource::Sigpending, limit).unwrap();
        while monotonic_ns() < next_ns {
            std::hint::spin_loop();
        }
        assert_eq!(alarm.check(signal), NEVER);
        alarm.give_back();
    }
}
