// SPDX-License-Identifier: MIT OR Apache-2.0
//! Errors, each with its fix.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use crate::{Enforcement, Policy};

/// Why a real-time setting was refused. Each message names the object, the limit and the fix.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RtError {
    /// A real-time priority outside 1..=99.
    #[error("priority {priority} is out of range: SCHED_FIFO and SCHED_RR take 1 (lowest) to 99 (highest)")]
    BadPriority {
        /// The requested priority.
        priority: u8,
    },
    /// A nice value outside -20..=19.
    #[error("nice {nice} is out of range: SCHED_OTHER takes -20 (most time) to 19 (least)")]
    BadNice {
        /// The requested nice value.
        nice: i8,
    },
    /// A reservation outside of the kernel's limits.
    #[error(
        "a reservation of {:?} in {:?} is out of range: SCHED_DEADLINE takes a runtime of 1.024µs to its period, 100µs to 4.194304s",
        Duration::from_nanos(*runtime_ns),
        Duration::from_nanos(*period_ns)
    )]
    BadReservation {
        /// The requested processor time, in nanoseconds.
        runtime_ns: u64,
        /// The period, in nanoseconds.
        period_ns: u64,
    },
    /// Other `SCHED_DEADLINE` threads leave no room for a reservation.
    #[error(
        "a reservation of {:?} in {:?} does not fit beside those of other SCHED_DEADLINE threads: lower one of them, or raise what \
         the kernel gives to all, `sudo sysctl kernel.sched_rt_runtime_us` of each kernel.sched_rt_period_us (-1: no limit)",
        Duration::from_nanos(*runtime_ns),
        Duration::from_nanos(*period_ns)
    )]
    NoBandwidth {
        /// The requested processor time, in nanoseconds.
        runtime_ns: u64,
        /// The period, in nanoseconds.
        period_ns: u64,
    },
    /// No privilege for `SCHED_DEADLINE`: no user limit can grant it.
    #[error(
        "SCHED_DEADLINE needs CAP_SYS_NICE: run `sudo setcap cap_sys_nice,cap_ipc_lock+ep {}` (RLIMIT_RTPRIO is not enough)",
        exe.display()
    )]
    ReservationRefused {
        /// This executable.
        exe: PathBuf,
    },
    /// A `SCHED_DEADLINE` thread is bound to only some of the cores between which the kernel balances.
    #[error(
        "the kernel refuses SCHED_DEADLINE to a thread that is bound to cores {cores}, some of those between which it balances: \
         let the thread run on any core (`core = \"any\"` in the system file), take the limit off real-time work, \
         `sudo sysctl -w kernel.sched_rt_runtime_us=-1`, or give it a cpuset of its own (`cpuset.cpus.partition` = root)"
    )]
    ReservationBound {
        /// The requested cores.
        cores: String,
    },
    /// [`Policy::Unmanaged`] can be read, not set.
    #[error(
        "kernel policy {number} can be read but not set: use Policy::Fifo, RoundRobin, Deadline or Other"
    )]
    UnmanagedPolicy {
        /// The kernel's number for the policy.
        number: u32,
    },
    /// A core set without cores.
    #[error("the core set is empty: name at least one of the cores {online}")]
    NoCores {
        /// The cores that are online.
        online: String,
    },
    /// A core that is not online.
    #[error("core {core} does not exist here: choose from {online}")]
    UnknownCore {
        /// The requested core.
        core: usize,
        /// The cores that are online.
        online: String,
    },
    /// A core that is online but not allowed by this process's cpuset.
    #[error(
        "cores {asked} are not all allowed to this process: choose from {allowed}, or widen its cpuset \
         (AllowedCPUs= of the systemd unit, --cpuset-cpus of the container)"
    )]
    CoreNotAllowed {
        /// The requested cores.
        asked: String,
        /// The cores the process may use.
        allowed: String,
    },
    /// The kernel accepted a policy and then reported another.
    #[error(
        "thread {tid} was set to {asked}, yet the kernel reports {reported}: stop whatever else sets its policy"
    )]
    PolicyNotKept {
        /// The thread.
        tid: u32,
        /// What was set.
        asked: Policy,
        /// What was read back.
        reported: Policy,
    },
    /// The kernel accepted an affinity and then reported another.
    #[error(
        "thread {tid} was bound to cores {asked}, yet the kernel reports {reported}: stop whatever else binds it"
    )]
    CoresNotKept {
        /// The thread.
        tid: u32,
        /// What was set.
        asked: String,
        /// What was read back.
        reported: String,
    },
    /// No privilege for real-time priorities at all.
    #[error(
        "real-time priority {priority} needs CAP_SYS_NICE: run `sudo setcap cap_sys_nice,cap_ipc_lock+ep {}`, \
         or add the line `@realtime - rtprio {}` to /etc/security/limits.d/90-tautline.conf, join the group \
         `realtime` and log in again; a container needs `--cap-add sys_nice --ulimit rtprio=99`",
        exe.display(),
        priority.max(&98)
    )]
    MissingCapability {
        /// The requested priority.
        priority: u8,
        /// This executable.
        exe: PathBuf,
    },
    /// `RLIMIT_RTPRIO` allows lower priorities only.
    #[error(
        "real-time priority {priority} is above this user's limit of {limit} (RLIMIT_RTPRIO): put the line \
         `@realtime - rtprio {priority}` into /etc/security/limits.d/90-tautline.conf, join the group `realtime` and log in \
         again, or choose at most {limit}"
    )]
    PriorityLimit {
        /// The requested priority.
        priority: u8,
        /// The highest one allowed.
        limit: u64,
    },
    /// The process's cpu cgroup has no real-time runtime (`CONFIG_RT_GROUP_SCHED`).
    #[error(
        "real-time priority {priority} is refused because the cpu cgroup has no real-time runtime: run \
         `echo 950000 | sudo tee {}`, or start the container with `--cpu-rt-runtime=950000`",
        path.display()
    )]
    NoGroupRuntime {
        /// The requested priority.
        priority: u8,
        /// The file that holds the runtime, in µs.
        path: PathBuf,
    },
    /// Refused although privilege and limits are sufficient: by a container's filter, or by a cgroup that hides
    /// its runtime.
    #[error(
        "real-time priority {priority} is refused although privilege and limits suffice: in a container start it \
         with `--cap-add sys_nice --ulimit rtprio=99`; otherwise leave the cpu cgroup with \
         `echo $$ | sudo tee /sys/fs/cgroup/cgroup.procs`"
    )]
    RealtimeRefused {
        /// The requested priority.
        priority: u8,
    },
    /// Too little privilege to lower the nice value.
    #[error(
        "nice {nice} needs CAP_SYS_NICE: run `sudo setcap cap_sys_nice,cap_ipc_lock+ep {}`, or put the line \
         `@realtime - nice {nice}` into /etc/security/limits.d/90-tautline.conf, join the group `realtime` and log in again",
        exe.display()
    )]
    NiceRefused {
        /// The requested nice value.
        nice: i8,
        /// This executable.
        exe: PathBuf,
    },
    /// A budget that was used up was not enforced.
    #[error(
        "a thread at SCHED_FIFO {} that had used its budget was not demoted by {by}: choose priorities of at most 98, take other \
         threads at SCHED_FIFO {below} and above off its cores, and on PREEMPT_RT raise the kernel's timers: \
         `for p in $(pgrep ktimers/); do sudo chrt -f -p 98 $p; done`",
        below.saturating_sub(1)
    )]
    BudgetNotEnforced {
        /// What should have enforced it.
        by: Enforcement,
        /// The priority below which it should have been enforced.
        below: u8,
    },
    /// Memory may not be locked, or not this much.
    #[error(
        "memory cannot be locked with a limit of {limit} (RLIMIT_MEMLOCK): run \
         `sudo setcap cap_sys_nice,cap_ipc_lock+ep {}`, or put the line `@realtime - memlock unlimited` into \
         /etc/security/limits.d/90-tautline.conf, join the group `realtime` and log in again; a container needs \
         `--ulimit memlock=-1`",
        exe.display()
    )]
    MemoryLock {
        /// The limit, with its unit.
        limit: String,
        /// This executable.
        exe: PathBuf,
        /// The kernel's error.
        source: io::Error,
    },
    /// `/dev/cpu_dma_latency` cannot be held open.
    #[error(
        "idle states cannot be held off through /dev/cpu_dma_latency: run as root, or put the line \
         `KERNEL==\"cpu_dma_latency\", GROUP=\"realtime\", MODE=\"0660\"` into \
         /etc/udev/rules.d/90-tautline.rules and run `sudo udevadm trigger --name-match=cpu_dma_latency`"
    )]
    Idle {
        /// The kernel's error.
        source: io::Error,
    },
    /// A stack size that is too large for a thread.
    #[error("a stack of {bytes} bytes for thread `{name}` is too large: choose at most {max} bytes")]
    StackTooLarge {
        /// The thread.
        name: String,
        /// The requested size.
        bytes: usize,
        /// The largest size accepted.
        max: usize,
    },
    /// No thread could be started.
    #[error(
        "thread `{name}` cannot be started: raise the limit of processes (ulimit -u) or of memory (ulimit -v, -l)"
    )]
    Spawn {
        /// The thread.
        name: String,
        /// The system's error.
        source: io::Error,
    },
    /// A thread panicked, in its set-up or later.
    #[error("thread `{name}` panicked: {message}")]
    Panicked {
        /// The thread.
        name: String,
        /// The panic's message.
        message: String,
    },
    /// A thread of the process that this one was forked from.
    #[error(
        "thread `{name}` belongs to the process that this one was forked from: start it anew after the fork"
    )]
    Forked {
        /// The thread.
        name: String,
    },
    /// A thread that does not exist, or no longer exists.
    #[error("thread {tid} does not exist: take its id from threads() while it runs")]
    NoSuchThread {
        /// The thread.
        tid: u32,
    },
    /// Any other error of the kernel.
    #[error("{what} failed: {source}")]
    Kernel {
        /// The call or the file.
        what: &'static str,
        /// The kernel's error.
        source: io::Error,
    },
}

impl RtError {
    /// Sorts an errno of a call that addresses a thread.
    pub(crate) fn of_thread(what: &'static str, tid: u32, source: io::Error) -> RtError {
        match source.raw_os_error() {
            Some(libc::ESRCH) => RtError::NoSuchThread { tid },
            _ => RtError::Kernel { what, source },
        }
    }
}
