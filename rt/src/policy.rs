// SPDX-License-Identifier: MIT OR Apache-2.0
//! Scheduling policies.

use std::fmt;
use std::time::Duration;

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
    /// `SCHED_DEADLINE`, with a deadline equal to the period: a reservation, which the kernel enforces as a limit (the
    /// constant-bandwidth server, `Documentation/scheduler/sched-deadline.rst`). It preempts every `SCHED_FIFO` thread, but a job that
    /// takes longer than reserved delays no other thread. Threads that it starts are `SCHED_OTHER`.
    Deadline {
        /// Processor time in each period, in nanoseconds: 1,024 to the period.
        runtime_ns: u64,
        /// In nanoseconds: 100 us to 4,194,304 us, the kernel's default limits (`kernel.sched_deadline_period_*`).
        period_ns: u64,
    },
    /// Another policy, by the kernel's number (3 batch, 5 idle, 6 deadline with a deadline other than the period): read back from a
    /// thread, never set.
    Unmanaged(u32),
}

impl Policy {
    /// The value of [`realtime_priority`](Self::realtime_priority) for a reservation: above all priorities.
    pub const RESERVATION: u8 = 100;

    /// The real-time priority, 1..=99, or [`RESERVATION`](Self::RESERVATION); `None` for a policy that has none.
    pub const fn realtime_priority(self) -> Option<u8> {
        match self {
            Policy::Fifo(priority) | Policy::RoundRobin(priority) => Some(priority),
            Policy::Deadline { .. } => Some(Self::RESERVATION),
            Policy::Other { .. } | Policy::Unmanaged(_) => None,
        }
    }
}

impl fmt::Display for Policy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Policy::Fifo(priority) => write!(f, "SCHED_FIFO {priority}"),
            Policy::RoundRobin(priority) => write!(f, "SCHED_RR {priority}"),
            Policy::Other { nice } => write!(f, "SCHED_OTHER nice {nice}"),
            Policy::Deadline { runtime_ns, period_ns } => {
                let [runtime, period] = [*runtime_ns, *period_ns].map(Duration::from_nanos);
                write!(f, "SCHED_DEADLINE {runtime:?} in {period:?}")
            }
            Policy::Unmanaged(number) => write!(f, "kernel policy {number}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn policies_print_as_the_kernel_names_them() {
        let printed =
            [Policy::Fifo(20), Policy::RoundRobin(3), Policy::Other { nice: -5 }, Policy::Unmanaged(6)]
                .map(|policy| policy.to_string());
        assert_eq!(printed, ["SCHED_FIFO 20", "SCHED_RR 3", "SCHED_OTHER nice -5", "kernel policy 6"]);
        let reserved = Policy::Deadline { runtime_ns: 2_500_000, period_ns: 20_000_000 };
        assert_eq!(reserved.to_string(), "SCHED_DEADLINE 2.5ms in 20ms");
    }
}
