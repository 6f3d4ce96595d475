// SPDX-License-Identifier: MIT OR Apache-2.0
//! The kernel's account of a thread's processor time, also readable from other threads and processes.

use std::fs;

/// Processor time of a thread since its start, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ThreadTime {
    /// Time in which it ran.
    pub used_ns: u64,
    /// Time in which it was ready to run, but other threads ran.
    pub waited_ns: u64,
}

impl ThreadTime {
    /// The time of a thread of any process, by its id. `None`: it has ended, or the kernel keeps no account
    /// (`CONFIG_SCHED_INFO`).
    ///
    /// # Real-time
    /// Not for real-time threads: allocates, and reads `/proc/TID/schedstat`.
    pub fn of(tid: u32) -> Option<ThreadTime> {
        let text = fs::read_to_string(format!("/proc/{tid}/schedstat")).ok()?;
        let mut numbers = text.split(' ').map_while(|number| number.parse().ok());
        Some(ThreadTime { used_ns: numbers.next()?, waited_ns: numbers.next()? })
    }

    /// The sum. It wraps, so that intermediate sums may be below zero.
    pub fn plus(self, other: ThreadTime) -> ThreadTime {
        ThreadTime {
            used_ns: self.used_ns.wrapping_add(other.used_ns),
            waited_ns: self.waited_ns.wrapping_add(other.waited_ns),
        }
    }

    /// The difference. It wraps, like [`plus`](Self::plus).
    pub fn minus(self, other: ThreadTime) -> ThreadTime {
        ThreadTime {
            used_ns: self.used_ns.wrapping_sub(other.used_ns),
            waited_ns: self.waited_ns.wrapping_sub(other.waited_ns),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_of_threads_is_read() {
        let time = ThreadTime::of;
        let tid = crate::current_tid();
        let before = time(tid).unwrap().used_ns;
        let mut n = 0_u64;
        while time(tid).unwrap().used_ns < before + 2_000_000 {
            n = n.wrapping_add(1);
        }
        assert_eq!(time(u32::MAX), None);
        // Of a thread that is not its process's first.
        let other = std::thread::spawn(move || (crate::current_tid(), time(crate::current_tid())));
        let (other, spent) = other.join().unwrap();
        assert!(other != tid && spent.is_some());
    }
}
