// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a callback thread is asked to be.

use std::time::Duration;

use tautline_rt::{CoreSet, Policy, ThreadBuilder};

/// The settings of a callback thread: plain data, checked when the callback is spawned.
///
/// ```
/// use tautline_executor::CallbackOptions;
/// use std::time::Duration;
///
/// let options = CallbackOptions::fifo(20).core(1).name("/odom").period(Duration::from_millis(10));
/// assert_eq!(options.effective_deadline(), Some(Duration::from_millis(10)));
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
#[must_use = "hand it to Executor::spawn_callback"]
pub struct CallbackOptions {
    /// Usually the topic. The thread is named `cb:<name>`, shortened to 15 bytes. Empty: the callback's number.
    pub name: String,
    /// How the thread is scheduled.
    pub policy: Policy,
    /// Where it may run; `None`: where the thread that spawns it may.
    pub cores: Option<CoreSet>,
    /// The size of its stack, which is touched before the thread turns real-time.
    pub stack_bytes: usize,
    /// The least time between two releases; only the deadline's default depends on it.
    pub period: Option<Duration>,
    /// A response longer than this is an overrun. `None`: the period.
    pub deadline: Option<Duration>,
    /// Poll all the time instead of parking: see [`CallbackOptions::busy_poll`].
    pub busy_poll: bool,
    /// Measure execution times, at one syscall per job (none if the thread polls busily). On by default.
    pub execution_time: bool,
}

impl CallbackOptions {
    /// `SCHED_FIFO` at a priority of 1 (lowest) to 99.
    pub const fn fifo(priority: u8) -> CallbackOptions {
        CallbackOptions::new(Policy::Fifo(priority))
    }

    /// `SCHED_OTHER`: for work without a deadline.
    pub const fn other() -> CallbackOptions {
        CallbackOptions::new(Policy::Other { nice: 0 })
    }

    /// Any policy.
    pub const fn new(policy: Policy) -> CallbackOptions {
        CallbackOptions {
            name: String::new(),
            policy,
            cores: None,
            stack_bytes: ThreadBuilder::STACK_BYTES,
            period: None,
            deadline: None,
            busy_poll: false,
            execution_time: true,
        }
    }

    /// Sets the name.
    pub fn name(mut self, name: impl Into<String>) -> CallbackOptions {
        self.name = name.into();
        self
    }

    /// Binds the thread to one core.
    pub const fn core(self, core: usize) -> CallbackOptions {
        self.cores(CoreSet::one(core))
    }

    /// Binds the thread to a set of cores.
    pub const fn cores(mut self, cores: CoreSet) -> CallbackOptions {
        self.cores = Some(cores);
        self
    }

    /// Sets the size of the stack.
    pub const fn stack_bytes(mut self, bytes: usize) -> CallbackOptions {
        self.stack_bytes = bytes;
        self
    }

    /// Sets the period, and with it the deadline unless one is set.
    pub const fn period(mut self, period: Duration) -> CallbackOptions {
        self.period = Some(period);
        self
    }

    /// Sets the deadline, relative to the release.
    pub const fn deadline(mut self, deadline: Duration) -> CallbackOptions {
        self.deadline = Some(deadline);
        self
    }

    /// Polls the callback in a loop on a core of its own: no wake-up, no parking, one core at 100 %.
    ///
    /// Needs exactly one core, and is refused where it would starve a thread that the executor knows of. Others it
    /// cannot protect: at a real-time priority, keep them off that core (`isolcpus`, or their affinity), for all they
    /// get there is what `sched_rt_runtime_us` leaves them.
    pub const fn busy_poll(mut self) -> CallbackOptions {
        self.busy_poll = true;
        self
    }

    /// Says whether execution times are measured.
    pub const fn execution_time(mut self, measured: bool) -> CallbackOptions {
        self.execution_time = measured;
        self
    }

    /// The deadline, or else the period.
    pub const fn effective_deadline(&self) -> Option<Duration> {
        match self.deadline {
            Some(deadline) => Some(deadline),
            None => self.period,
        }
    }
}
