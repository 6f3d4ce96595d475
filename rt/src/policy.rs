// SPDX-License-Identifier: MIT OR Apache-2.0
//! Scheduling policies: set, and read back from the kernel.

use std::{fmt, io, mem};

use thread_priority::{
    Error as SetError, RealtimeThreadSchedulePolicy as Realtime, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use crate::cores::pid;
use crate::{RtError, current_tid, permission};

/// How the kernel schedules a thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Policy {
    /// `SCHED_FIFO` at a priority of 1 (lowest) to 99: runs until it blocks or a higher priority is ready.
    Fifo(u8),
    /// `SCHED_RR` at a priority of 1 (lowest) to 99: FIFO with time slices among equal priorities.
    RoundRobin(u8),
    /// `SCHED_OTHER`: time sharing, below every real-time thread.
    Other {
        /// -20 (most time) to 19 (least).
        nice: i8,
    },
    /// Another policy, by the kernel's number (3 batch, 5 idle, 6 deadline): read back from a thread, never set.
    Unmanaged(u32),
}

impl Policy {
    /// The real-time priority, 1..=99; `None` for a policy that has none.
    pub const fn realtime_priority(self) -> Option<u8> {
        match self {
            Policy::Fifo(priority) | Policy::RoundRobin(priority) => Some(priority),
            Policy::Other { .. } | Policy::Unmanaged(_) => None,
        }
    }

    /// Says whether this is a policy that [`set_policy`] could set, privilege aside.
    ///
    /// # Errors
    /// [`RtError::BadPriority`], [`RtError::BadNice`], [`RtError::UnmanagedPolicy`].
    pub const fn check(self) -> Result<(), RtError> {
        match self {
            Policy::Fifo(1..=99) | Policy::RoundRobin(1..=99) | Policy::Other { nice: -20..=19 } => Ok(()),
            Policy::Fifo(priority) | Policy::RoundRobin(priority) => Err(RtError::BadPriority { priority }),
            Policy::Other { nice } => Err(RtError::BadNice { nice }),
            Policy::Unmanaged(number) => Err(RtError::UnmanagedPolicy { number }),
        }
    }
}

impl fmt::Display for Policy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Policy::Fifo(priority) => write!(f, "SCHED_FIFO {priority}"),
            Policy::RoundRobin(priority) => write!(f, "SCHED_RR {priority}"),
            Policy::Other { nice } => write!(f, "SCHED_OTHER nice {nice}"),
            Policy::Unmanaged(number) => write!(f, "kernel policy {number}"),
        }
    }
}

/// Sets the policy of the current thread and reads it back.
///
/// # Errors
/// [`RtError::BadPriority`] and the like for values that cannot be; a variant that names the fix when the privilege
/// is missing (see [`permission`]); [`RtError::PolicyNotKept`] if the kernel then reports another policy.
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

/// Sets the policy of thread `tid` and reads it back.
///
/// # Errors
/// As [`set_policy`]; [`RtError::NoSuchThread`] when the thread has ended.
pub fn set_policy_of(tid: u32, policy: Policy) -> Result<(), RtError> {
    policy.check()?;
    let (class, nice, priority) = match policy {
        Policy::Fifo(priority) => (libc::SCHED_FIFO, 0, priority),
        Policy::RoundRobin(priority) => (libc::SCHED_RR, 0, priority),
        Policy::Other { nice } => (libc::SCHED_OTHER, nice, 0),
        Policy::Unmanaged(number) => return Err(RtError::UnmanagedPolicy { number }),
    };
    let thread = pid(tid)?.as_raw_nonzero().get();
    let attr = libc::sched_attr {
        sched_policy: class.cast_unsigned(),
        sched_nice: nice.into(),
        sched_priority: priority.into(),
        ..empty_attr()
    };
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
        _ => Policy::Unmanaged(attr.sched_policy),
    })
}

fn confirm(tid: u32, asked: Policy) -> Result<(), RtError> {
    let reported = policy_of(tid)?;
    if reported == asked { Ok(()) } else { Err(RtError::PolicyNotKept { tid, asked, reported }) }
}

fn refused(tid: u32, policy: Policy, source: io::Error) -> RtError {
    match (source.raw_os_error(), policy) {
        (Some(libc::EPERM), Policy::Fifo(n) | Policy::RoundRobin(n)) => permission::diagnose(n),
        (Some(libc::EPERM | libc::EACCES), Policy::Other { nice }) => {
            RtError::NiceRefused { nice, exe: permission::current_exe() }
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
    }

    #[test]
    fn policies_print_as_the_kernel_names_them() {
        let printed =
            [Policy::Fifo(20), Policy::RoundRobin(3), Policy::Other { nice: -5 }, Policy::Unmanaged(6)]
                .map(|policy| policy.to_string());
        assert_eq!(printed, ["SCHED_FIFO 20", "SCHED_RR 3", "SCHED_OTHER nice -5", "kernel policy 6"]);
    }
}
