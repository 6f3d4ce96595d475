// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a thread's time was used, by the kernel's own clocks: the time that it ran, the time that it waited for the core, and the
//! rest, which no thread of this machine had.
//!
//! ```text
//!  wall time between two marks
//!    = processor time of the thread            CLOCK_THREAD_CPUTIME_ID; on a guest it stands still while the host has the core
//!    + time in the run queue                   /proc/thread-self/schedstat: others ran, or were to run
//!    + time asleep                             0 if the thread has not slept: getrusage
//!    + time taken from it while it ran         steal, and interrupts where the kernel accounts for them by themselves
//! ```
//!
//! Needs Linux with `CONFIG_SCHED_INFO`. A guest's kernel excludes stolen time from the processor time only
//! with `CONFIG_PARAVIRT_TIME_ACCOUNTING`; without it, stolen time looks like the thread's own work.

use std::io;
use std::marker::PhantomData;
use std::os::fd::OwnedFd;

use rustix::fs::{Mode, OFlags};

use crate::RtError;
use crate::clock::{monotonic_ns, thread_cpu_ns};
use crate::memory::thread_usage;

/// Reads the current thread's time account. Each thread creates its own.
///
/// ```
/// let account = tautline_rt::CoreTime::new()?;
/// let before = account.mark();
/// let sum: u64 = (0..1_000).sum(); // some work
/// let after = account.mark();
/// assert!(before.taken_until(&after).is_some(), "it has not slept: {sum}");
/// # Ok::<(), tautline_rt::RtError>(())
/// ```
#[derive(Debug)]
pub struct CoreTime {
    schedstat: OwnedFd,
    /// The file belongs to the thread that opened it.
    _thread: PhantomData<*const ()>,
}

/// A thread's time account at one moment. The moment lies between two times, because reading takes a microsecond, in which
/// other threads may run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CoreMark {
    /// The time before the account was read, in `CLOCK_MONOTONIC` ns.
    pub from_ns: u64,
    /// The time after it was read.
    pub to_ns: u64,
    /// Processor time that the thread has used.
    pub used_ns: u64,
    /// Time in which it was ready to run but did not run.
    pub waited_ns: u64,
    /// How often it went to sleep voluntarily.
    pub sleeps: u64,
}

impl CoreTime {
    /// Opens the current thread's account.
    ///
    /// # Errors
    /// [`RtError::Kernel`]: there is none, because /proc is not mounted or the kernel does not keep one.
    pub fn new() -> Result<CoreTime, RtError> {
        let failed = |source| RtError::Kernel { what: "reading /proc/thread-self/schedstat", source };
        let flags = OFlags::RDONLY | OFlags::CLOEXEC;
        let schedstat = rustix::fs::open("/proc/thread-self/schedstat", flags, Mode::empty())
            .map_err(|errno| failed(errno.into()))?;
        let account = CoreTime { schedstat, _thread: PhantomData };
        // The kernel's buffer for the file is claimed by the first read.
        match account.waited_ns() {
            Some(_) => Ok(account),
            None => Err(failed(io::Error::other("it holds no numbers: the kernel lacks CONFIG_SCHED_INFO"))),
        }
    }

    /// The account now.
    ///
    /// # Real-time
    /// No allocation; no wait; three syscalls, which take 1.5 µs together.
    pub fn mark(&self) -> CoreMark {
        let from_ns = monotonic_ns();
        let used_ns = thread_cpu_ns();
        let waited_ns = self.waited_ns().unwrap_or(u64::MAX);
        let sleeps = sleeps();
        CoreMark { from_ns, to_ns: monotonic_ns(), used_ns, waited_ns, sleeps }
    }

    /// The second number of `used waited slices`, all in ns but for the last.
    fn waited_ns(&self) -> Option<u64> {
        // Three numbers of 20 digits at most.
        let mut text = [0; 64];
        let len = rustix::io::pread(&self.schedstat, &mut text, 0).ok()?;
        second_number(text.get(..len)?)
    }
}

impl CoreMark {
    /// Time taken from the thread while it ran, from this mark to a later one: by the hypervisor, or by interrupts. Time in which
    /// the thread waited for other threads is not included. `None` if the thread has slept meanwhile, or if the kernel did not
    /// provide the data.
    ///
    /// Events during the reading of a mark make the value smaller, never larger.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn taken_until(&self, later: &CoreMark) -> Option<u64> {
        (self.sleeps == later.sleeps).then_some(())?;
        let wall_ns = later.from_ns.saturating_sub(self.to_ns);
        let known_ns = later.used_ns.saturating_sub(self.used_ns).saturating_add(self.waited_until(later)?);
        Some(wall_ns.saturating_sub(known_ns))
    }

    /// For a thread that slept at this mark, and that a timer should have woken at `due_ns`: how much later it was ready to run.
    /// Until then the timer had not been served. `None` if the thread was not yet asleep at `due_ns`, or if the kernel did not
    /// provide the data.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn woken_late_by(&self, due_ns: u64, later: &CoreMark) -> Option<u64> {
        (due_ns >= self.to_ns && later.sleeps != self.sleeps).then_some(())?;
        Some(later.from_ns.saturating_sub(due_ns).saturating_sub(self.waited_until(later)?))
    }

    /// How long the thread was ready to run but did not run, from this mark to a later one. `None` if the kernel did not
    /// provide the data.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn waited_until(&self, later: &CoreMark) -> Option<u64> {
        let told = |mark: &CoreMark| (mark.waited_ns != u64::MAX).then_some(mark.waited_ns);
        Some(told(later)?.saturating_sub(told(self)?))
    }
}

/// How often the current thread has gone to sleep by itself.
fn sleeps() -> u64 {
    thread_usage().ru_nvcsw.cast_unsigned()
}

fn second_number(text: &[u8]) -> Option<u64> {
    let digits = text.split(|byte| *byte == b' ').nth(1)?;
    let digit = |byte: &u8| byte.is_ascii_digit().then(|| u64::from(byte - b'0'));
    let add = |sum: u64, byte: &u8| sum.checked_mul(10)?.checked_add(digit(byte)?);
    (!digits.is_empty()).then(|| digits.iter().try_fold(0, add))?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::burn_cpu;
    use crate::{CoreSet, Realtime, ThreadBuilder, current_affinity};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Duration;

    fn mark(at_ns: u64, used_ns: u64, waited_ns: u64, sleeps: u64) -> CoreMark {
        CoreMark { from_ns: at_ns, to_ns: at_ns + 1, used_ns, waited_ns, sleeps }
    }

    #[test]
    fn the_rest_of_the_time_was_taken() {
        let before = mark(1_000, 50, 70, 3);
        assert_eq!(before.taken_until(&mark(2_001, 450, 370, 3)), Some(1_000 - 400 - 300));
        assert_eq!(before.taken_until(&mark(2_001, 1_450, 370, 3)), Some(0), "clocks that disagree");
        assert_eq!(before.taken_until(&mark(2_001, 450, 370, 4)), None, "it slept");
        assert_eq!(before.taken_until(&mark(2_001, 450, u64::MAX, 3)), None, "the kernel did not tell");
    }

    #[test]
    fn a_clock_that_nobody_served_wakes_late() {
        let asleep = mark(1_000, 50, 70, 3);
        assert_eq!(asleep.woken_late_by(1_500, &mark(1_900, 51, 170, 4)), Some(400 - 100));
        assert_eq!(asleep.woken_late_by(1_000, &mark(1_900, 51, 170, 4)), None, "due before it could sleep");
        assert_eq!(asleep.woken_late_by(1_500, &mark(1_900, 51, 170, 3)), None, "it did not sleep");
    }

    #[test]
    fn only_numbers_are_read() {
        assert_eq!(second_number(b"123 456 7\n"), Some(456));
        assert_eq!(second_number(b"18446744073709551615 18446744073709551615 1\n"), Some(u64::MAX));
        for text in ["", "12", "1 ", "1 x 3", "1 18446744073709551616 3", "1  3"] {
            assert_eq!(second_number(text.as_bytes()), None, "{text:?}");
        }
    }

    /// Another thread that has the same core for much of the time: what this one is kept waiting was not taken from it.
    #[test]
    fn what_others_use_is_waited_for_and_not_taken() {
        let core = CoreSet::one(current_affinity().unwrap().iter().next().unwrap());
        let over = Arc::new(AtomicBool::new(false));
        let spawn = |name: &str, work: Box<dyn FnOnce() -> (u64, u64) + Send>| {
            let builder = ThreadBuilder::new(name).cores(core).realtime(Realtime::Off);
            builder.spawn(move || move || work()).unwrap()
        };
        let other = {
            let over = Arc::clone(&over);
            let spin = move || {
                while !over.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
                (0, 0)
            };
            spawn("other", Box::new(spin))
        };
        let measure = || {
            let account = CoreTime::new().unwrap();
            let before = account.mark();
            burn_cpu(Duration::from_millis(200));
            let after = account.mark();
            let (wall_ns, waited_ns) = (after.from_ns - before.to_ns, after.waited_ns - before.waited_ns);
            // The clocks of an emulated machine differ by a hundredth.
            (
                wall_ns - 200_000_000 + wall_ns / 50,
                waited_ns + before.taken_until(&after).expect("it has not slept"),
            )
        };
        let measured = spawn("measured", Box::new(measure));
        let (beyond_ns, explained_ns) = measured.join().unwrap();
        over.store(true, Ordering::Relaxed);
        other.join().unwrap();
        // The other had as much of the core, and not a nanosecond is explained twice.
        assert!(beyond_ns > 50_000_000 && explained_ns <= beyond_ns, "{explained_ns} of {beyond_ns} ns");
        assert!(explained_ns > beyond_ns / 2, "{explained_ns} of {beyond_ns} ns");
    }
}
