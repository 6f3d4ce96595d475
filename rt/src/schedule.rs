// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sets scheduling policies, and reads them back from the kernel.

use std::{io, mem};

use thread_priority::{
    Error as SetError, RealtimeThreadSchedulePolicy as Realtime, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use crate::tid::pid;
use crate::{Policy, RtError, current_tid, refusal};

/// As in the kernel's `include/uapi/linux/sched.h`.
const SCHED_DEADLINE: libc::c_int = 6;

impl Policy {
    /// Checks whether [`set_policy`] could set this policy, without regard to privilege.
    ///
    /// # Errors
    /// [`RtError::BadPriority`], [`RtError::BadNice`], [`RtError::BadReservation`], [`RtError::UnmanagedPolicy`].
    pub const fn check(self) -> Result<(), RtError> {
        match self {
            Policy::Fifo(1..=99) | Policy::RoundRobin(1..=99) | Policy::Other { nice: -20..=19 } => Ok(()),
            Policy::Fifo(priority) | Policy::RoundRobin(priority) => Err(RtError::BadPriority { priority }),
            Policy::Other { nice } => Err(RtError::BadNice { nice }),
            Policy::Deadline { runtime_ns: 1_024.., period_ns: 100_000..=4_194_304_000 }
                if self.fits_its_period() =>
            {
                Ok(())
            }
            Policy::Deadline { runtime_ns, period_ns } => {
                Err(RtError::BadReservation { runtime_ns, period_ns })
            }
            Policy::Unmanaged(number) => Err(RtError::UnmanagedPolicy { number }),
        }
    }

    const fn fits_its_period(self) -> bool {
        matches!(self, Policy::Deadline { runtime_ns, period_ns } if runtime_ns <= period_ns)
    }
}

/// Sets the policy of the current thread and reads it back.
///
/// # Errors
/// [`RtError::BadPriority`] and similar for invalid values; a variant that names the fix if the privilege is
/// missing (see [`permission`](crate::permission)); [`RtError::PolicyNotKept`] if the kernel then reports another policy.
pub fn set_policy(policy: Policy) -> Result<(), RtError> {
    policy.check()?;
    let (class, priority) = match policy {
        Policy::Fifo(priority) => (Realtime::Fifo, priority),
        Policy::RoundRobin(priority) => (Realtime::RoundRobin, priority),
        // thread-priority maps nice through a percentage: only the kernel's own call keeps the exact value.
        _ => return set_policy_of(current_tid(), policy),
    };
    let value = ThreadPriority::try_from(priority).map_err(|_| RtError::BadPriority { priority })?;
    match set_thread_priority_and_policy(thread_native_id(), value, ThreadSchedulePolicy::Realtime(class)) {
        Ok(()) => confirm(current_tid(), policy),
        Err(SetError::OS(errno)) => Err(refused(current_tid(), policy, io::Error::from_raw_os_error(errno))),
        Err(_) => Err(RtError::BadPriority { priority }),
    }
}

/// Gives the current thread SCHED_FIFO with a priority, and reads it back. Threads and processes that it starts are ordinary, unlike those
/// after [`set_policy`].
///
/// # Errors
/// As [`set_policy`].
pub fn set_own_priority(priority: u8) -> Result<(), RtError> {
    set_policy_with(
        current_tid(),
        Policy::Fifo(priority),
        libc::SCHED_FLAG_RESET_ON_FORK.cast_unsigned().into(),
    )
}

/// Gives the current thread another SCHED_FIFO priority, after [`set_own_priority`], without reading it back: for each job of a thread whose
/// jobs have priorities of their own. Of equal priorities the kernel puts the thread first when it gets a lower one, and last when it gets a
/// higher one.
///
/// # Real-time
/// One syscall; no allocation unless it fails.
///
/// # Errors
/// As [`set_policy`], except [`RtError::PolicyNotKept`].
pub fn switch_own_priority(priority: u8) -> Result<(), RtError> {
    let policy = Policy::Fifo(priority);
    policy.check()?;
    // A thread without privileges cannot clear the flag.
    match schedule(policy, libc::SCHED_RESET_ON_FORK) {
        true => Ok(()),
        false => Err(refused(current_tid(), policy, io::Error::last_os_error())),
    }
}

/// Sets the policy of this thread, by the bare system call: for a signal handler.
pub(crate) fn schedule(policy: Policy, flags: libc::c_int) -> bool {
    let (class, priority) = match policy {
        Policy::Fifo(priority) => (libc::SCHED_FIFO, priority),
        Policy::RoundRobin(priority) => (libc::SCHED_RR, priority),
        _ => (libc::SCHED_OTHER, 0),
    };
    let param = libc::sched_param { sched_priority: priority.into() };
    // SAFETY: `param` outlives the call; 0 is the calling thread.
    unsafe { libc::syscall(libc::SYS_sched_setscheduler, 0, class | flags, &raw const param) == 0 }
}

/// Sets the policy of thread `tid` and reads it back.
///
/// # Errors
/// As [`set_policy`]; [`RtError::NoSuchThread`] when the thread has ended.
pub fn set_policy_of(tid: u32, policy: Policy) -> Result<(), RtError> {
    set_policy_with(tid, policy, 0)
}

fn set_policy_with(tid: u32, policy: Policy, flags: u64) -> Result<(), RtError> {
    policy.check()?;
    let mut attr = empty_attr();
    attr.sched_flags = flags;
    let class = match policy {
        Policy::Fifo(priority) => {
            attr.sched_priority = priority.into();
            libc::SCHED_FIFO
        }
        Policy::RoundRobin(priority) => {
            attr.sched_priority = priority.into();
            libc::SCHED_RR
        }
        Policy::Other { nice } => {
            attr.sched_nice = nice.into();
            libc::SCHED_OTHER
        }
        Policy::Deadline { runtime_ns, period_ns } => {
            (attr.sched_runtime, attr.sched_deadline, attr.sched_period) = (runtime_ns, period_ns, period_ns);
            // Without this flag the thread could start no threads at all.
            attr.sched_flags = u64::from(libc::SCHED_FLAG_RESET_ON_FORK.cast_unsigned());
            SCHED_DEADLINE
        }
        Policy::Unmanaged(number) => return Err(RtError::UnmanagedPolicy { number }),
    };
    attr.sched_policy = class.cast_unsigned();
    let thread = pid(tid)?.as_raw_nonzero().get();
    // SAFETY: `attr` is a valid sched_attr of the size it states and outlives the call, which only reads it.
    let answer = unsafe { libc::syscall(libc::SYS_sched_setattr, thread, &raw const attr, 0) };
    if answer != 0 {
        return Err(refused(tid, policy, io::Error::last_os_error()));
    }
    confirm(tid, policy)
}

/// The policy of the current thread, as the kernel reports it.
///
/// # Errors
/// [`RtError::Kernel`] if the kernel does not answer.
pub fn current_policy() -> Result<Policy, RtError> {
    policy_of(current_tid())
}

/// The policy of thread `tid`, as the kernel reports it.
///
/// # Errors
/// [`RtError::NoSuchThread`] when the thread has ended.
pub fn policy_of(tid: u32) -> Result<Policy, RtError> {
    let thread = pid(tid)?.as_raw_nonzero().get();
    // Not pthread_getschedparam: glibc answers that from its own copy of what was last set.
    let mut attr = empty_attr();
    // SAFETY: `attr` is writable for the size passed, and any bytes the kernel writes are a valid sched_attr.
    let answer = unsafe { libc::syscall(libc::SYS_sched_getattr, thread, &raw mut attr, attr.size, 0) };
    if answer != 0 {
        return Err(RtError::of_thread("sched_getattr", tid, io::Error::last_os_error()));
    }
    let priority = u8::try_from(attr.sched_priority).unwrap_or(u8::MAX);
    Ok(match attr.sched_policy.cast_signed() {
        libc::SCHED_FIFO => Policy::Fifo(priority),
        libc::SCHED_RR => Policy::RoundRobin(priority),
        libc::SCHED_OTHER => Policy::Other { nice: i8::try_from(attr.sched_nice).unwrap_or(i8::MAX) },
        SCHED_DEADLINE if attr.sched_deadline == attr.sched_period => {
            Policy::Deadline { runtime_ns: attr.sched_runtime, period_ns: attr.sched_period }
        }
        _ => Policy::Unmanaged(attr.sched_policy),
    })
}

fn confirm(tid: u32, asked: Policy) -> Result<(), RtError> {
    let reported = policy_of(tid)?;
    if reported == asked { Ok(()) } else { Err(RtError::PolicyNotKept { tid, asked, reported }) }
}

fn refused(tid: u32, policy: Policy, source: io::Error) -> RtError {
    match (source.raw_os_error(), policy) {
        (Some(libc::EPERM), Policy::Fifo(n) | Policy::RoundRobin(n)) => refusal::diagnose(n),
        (Some(libc::EPERM), Policy::Deadline { .. }) => refusal::diagnose_reservation(tid),
        (Some(libc::EBUSY), Policy::Deadline { runtime_ns, period_ns }) => {
            RtError::NoBandwidth { runtime_ns, period_ns }
        }
        (Some(libc::EPERM | libc::EACCES), Policy::Other { nice }) => {
            RtError::NiceRefused { nice, exe: refusal::current_exe() }
        }
        _ => RtError::of_thread("sched_setattr", tid, source),
    }
}

fn empty_attr() -> libc::sched_attr {
    libc::sched_attr {
        size: u32::try_from(mem::size_of::<libc::sched_attr>()).unwrap_or(0),
        sched_policy: 0,
        sched_flags: 0,
        sched_nice: 0,
        sched_priority: 0,
        sched_runtime: 0,
        sched_deadline: 0,
        sched_period: 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_outside_the_range_are_refused_before_the_kernel_sees_them() {
        for bad in [Policy::Fifo(0), Policy::Fifo(100), Policy::RoundRobin(255)] {
            let message = set_policy(bad).unwrap_err().to_string();
            assert!(message.contains("1 (lowest) to 99"), "{message}");
        }
        assert!(matches!(set_policy(Policy::Other { nice: 20 }), Err(RtError::BadNice { nice: 20 })));
        assert!(matches!(set_policy(Policy::Unmanaged(5)), Err(RtError::UnmanagedPolicy { number: 5 })));
        for (runtime_ns, period_ns) in
            [(1_023, 100_000), (2_000, 99_999), (200_001, 200_000), (1 << 20, 1 << 33)]
        {
            let message = set_policy(Policy::Deadline { runtime_ns, period_ns }).unwrap_err().to_string();
            assert!(message.contains("1.024µs to its period, 100µs to 4.194304s"), "{message}");
        }
    }
}
