// SPDX-License-Identifier: MIT OR Apache-2.0
//! The clocks, in nanoseconds.

use std::time::Duration;

use rustix::thread::{ClockId as SleepClock, clock_nanosleep_absolute};
use rustix::time::{ClockId, Timespec, clock_gettime};

/// `CLOCK_MONOTONIC`: ns since an arbitrary start, the same in all processes of this machine.
///
/// # Real-time
/// Wait-free; no allocation; no syscall where the kernel maps its clock (vDSO).
pub fn monotonic_ns() -> u64 {
    of_timespec(clock_gettime(ClockId::Monotonic)).cast_unsigned()
}

/// `CLOCK_REALTIME`: ns since 1970-01-01 UTC. It jumps when the clock is set.
///
/// # Real-time
/// Wait-free; no allocation; no syscall where the kernel maps its clock (vDSO).
pub fn wall_ns() -> i64 {
    of_timespec(clock_gettime(ClockId::Realtime))
}

/// `CLOCK_THREAD_CPUTIME_ID`: ns of CPU time that the current thread has used.
///
/// # Real-time
/// Wait-free; no allocation; one syscall.
pub fn thread_cpu_ns() -> u64 {
    of_timespec(clock_gettime(ClockId::ThreadCPUTime)).cast_unsigned()
}

/// CPU time of thread `tid` of this process, in nanoseconds; 0 if there is no such thread.
///
/// # Real-time
/// Wait-free; no allocation; one syscall.
pub fn thread_cpu_ns_of(tid: u32) -> u64 {
    // As the kernel numbers clocks (`include/linux/posix-timers.h`): of a thread (4), the scheduler's account (2).
    let clock = (!tid.cast_signed() << 3) | 4 | 2;
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` is writable and outlives the call.
    unsafe { libc::clock_gettime(clock, &raw mut time) };
    (time.tv_sec * 1_000_000_000 + time.tv_nsec).cast_unsigned()
}

/// CPU time of all threads of this process, in nanoseconds.
///
/// # Real-time
/// One syscall; no allocation.
pub fn process_cpu_ns() -> u64 {
    of_timespec(clock_gettime(ClockId::ProcessCPUTime)).cast_unsigned()
}

/// Sleeps until [`monotonic_ns`] reaches `ns`; returns at once if it has. Signals do not cut it short.
///
/// # Real-time
/// No allocation; one syscall, which blocks.
pub fn sleep_until_monotonic(ns: u64) {
    // Both fit: u64::MAX ns is 584 years.
    let at =
        Timespec { tv_sec: (ns / 1_000_000_000).cast_signed(), tv_nsec: (ns % 1_000_000_000).cast_signed() };
    while clock_nanosleep_absolute(SleepClock::Monotonic, &at) == Err(rustix::io::Errno::INTR) {}
}

/// Computes until the current thread has used `time` more CPU time: time in which it was preempted does not count.
///
/// # Real-time
/// No allocation; one short syscall per turn; takes at least `time`.
pub fn burn_cpu(time: Duration) {
    let end = nanoseconds(time).saturating_add(thread_cpu_ns());
    while thread_cpu_ns() < end {
        std::hint::spin_loop();
    }
}

/// A time span of a test: `TAUT_TIME_SCALE` times as long, for machines on which a thread that could run often waits, such as emulated ones.
///
/// # Real-time
/// Reads the environment: setup only.
#[doc(hidden)]
pub fn test_time(time: Duration) -> Duration {
    let scale = std::env::var("TAUT_TIME_SCALE").ok().and_then(|scale| scale.parse().ok());
    time.saturating_mul(scale.unwrap_or(1))
}

/// A time span in nanoseconds, the unit of these clocks: at most 584 years.
pub fn nanoseconds(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)
}

fn of_timespec(time: Timespec) -> i64 {
    time.tv_sec * 1_000_000_000 + time.tv_nsec
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sleep_lasts_until_its_instant() {
        let wanted = monotonic_ns() + 2_000_000;
        sleep_until_monotonic(wanted);
        assert!(monotonic_ns() >= wanted);
        sleep_until_monotonic(0);
    }

    #[test]
    fn burning_uses_cpu_time_and_sleeping_does_not() {
        let start = thread_cpu_ns();
        burn_cpu(Duration::from_millis(2));
        let burnt = thread_cpu_ns();
        assert!(burnt - start >= 2_000_000);
        sleep_until_monotonic(monotonic_ns() + 20_000_000);
        assert!(thread_cpu_ns() - burnt < 20_000_000);
    }

    #[test]
    fn the_time_of_another_thread_is_its_own() {
        let tid = crate::current_tid();
        burn_cpu(Duration::from_millis(2));
        let (before, other) = (thread_cpu_ns(), std::thread::spawn(move || thread_cpu_ns_of(tid)));
        assert!(other.join().unwrap() >= before);
        assert_eq!(thread_cpu_ns_of(1 << 27), 0);
    }

    #[test]
    fn the_wall_clock_agrees_with_std() {
        let std_ns = || std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_nanos();
        let (before, now, after) = (std_ns(), u128::from(wall_ns().cast_unsigned()), std_ns());
        assert!(before <= now && now <= after);
    }
}
