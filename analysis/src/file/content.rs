// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a system file says, once every callback has its thread, core and priority.
use std::ops::Range;

use crate::system::System;
use crate::{LockProtocol, Reservation};

/// The longest queue that a topic may have: the transport has no longer ones.
pub const MOST_DEPTH: u64 = 65_536;

/// A system file without problems: the threads, cores and priorities of all callbacks are known.
///
/// ```
/// use tautline_analysis::file::SystemFile;
/// let text = r#"
///     [hosts.robot]
///     cores = 1
///     [nodes.driver]
///     [callbacks.scan]
///     period = "10ms"
///     wcet = "2ms"
/// "#;
/// let checked = SystemFile::parse(text)?.check();
/// assert!(checked.schedulable);
/// assert_eq!(checked.callbacks[0].response_ns, Some(2_000_000));
///
/// let problems = SystemFile::parse("[hosts.robot]\ncoers = 1").unwrap_err();
/// assert!(problems.to_string().contains("2:1: unknown key `coers` in host `robot`: did you mean `cores`?"));
/// # Ok::<(), tautline_analysis::file::Problems>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SystemFile {
    pub(super) callbacks: Vec<CallbackEntry>,
    /// The locks that its tasks take.
    pub(super) locks: Vec<Lock>,
    pub(super) topics: Vec<TopicEntry>,
    pub(super) cores: Vec<CoreEntry>,
    pub(super) warnings: Vec<String>,
    pub(super) system: System,
    pub(super) fingerprint: u64,
}

impl SystemFile {
    /// The callbacks, in the order of the file.
    pub fn callbacks(&self) -> &[CallbackEntry] {
        &self.callbacks
    }

    /// The topics that the file declares, then those that are only published.
    pub fn topics(&self) -> &[TopicEntry] {
        &self.topics
    }

    /// The cores of all hosts.
    pub fn cores(&self) -> &[CoreEntry] {
        &self.cores
    }

    /// The host that a process is on: `wanted`, or the only one.
    ///
    /// # Errors
    /// The names of all hosts, if there are several and `wanted` is none of them.
    pub fn host(&self, wanted: Option<&str>) -> Result<&str, Vec<&str>> {
        let mut hosts: Vec<&str> = self.cores.iter().map(|core| core.host.as_str()).collect();
        hosts.dedup();
        match wanted {
            Some(wanted) => hosts.iter().find(|host| **host == wanted).copied().ok_or(hosts),
            None if hosts.len() == 1 => Ok(hosts[0]),
            None => Err(hosts),
        }
    }

    /// A hash of the text, to find out whether two programs read the same file.
    pub fn fingerprint(&self) -> u64 {
        self.fingerprint
    }

    /// The system that is analysed.
    pub fn system(&self) -> &System {
        &self.system
    }

    /// The same on machines without overheads.
    pub fn system_without_overheads(&self) -> System {
        let mut free = self.system.clone();
        free.cores.iter_mut().for_each(|core| core.overheads = crate::Overheads::NONE);
        free.relays.clear();
        free.callbacks.iter_mut().for_each(|callback| callback.task = callback.task.without_overheads());
        free
    }

    /// The same on machines that stall, each core once until it has caught up. As in [`taken`](crate::taken), every task is blocked for its
    /// host's stall more. `None` if no host stalls.
    pub(super) fn system_with_stalls(&self) -> Option<System> {
        let stall_ns = |core: usize| self.cores[core].stall_ns;
        if self.cores.iter().all(|core| core.stall_ns == 0) {
            return None;
        }
        let mut stalled = self.system.clone();
        for (core, entry) in stalled.cores.iter_mut().zip(&self.cores) {
            core.stall_ns = entry.stall_ns;
        }
        for relay in &mut stalled.relays {
            let here_ns = stall_ns(relay.core);
            match &mut relay.source {
                Some((source, transfer)) => {
                    let from_ns = stall_ns(self.system.callbacks[*source].core);
                    transfer.most_ns = transfer.most_ns.saturating_add(from_ns).saturating_add(here_ns);
                }
                None => relay.release.jitter_ns = relay.release.jitter_ns.saturating_add(here_ns),
            }
        }
        for callback in &mut stalled.callbacks {
            let here = callback.core;
            callback.task.blocking_ns = callback.task.blocking_ns.saturating_add(stall_ns(here));
            if let Some((source, transfer)) = &mut callback.trigger {
                let from = self.system.callbacks[*source].core;
                if self.cores[from].host != self.cores[here].host {
                    // The gateways of both hosts are on cores that the file does not name.
                    let gateways_ns = stall_ns(from).saturating_add(stall_ns(here));
                    transfer.most_ns = transfer.most_ns.saturating_add(gateways_ns);
                }
            }
        }
        for entry in &self.callbacks {
            let stall_ns = stall_ns(entry.core);
            // Its sampler may be on another core.
            let split =
                self.callbacks.iter().any(|other| other.node == entry.node && other.core != entry.core);
            let remote = |topic: &TopicEntry| topic.remote && entry.topics.contains(&topic.name);
            let remote = self.topics.iter().any(remote);
            for callback in &mut stalled.callbacks[entry.tasks.clone()] {
                if split {
                    callback.task.blocking_ns = callback.task.blocking_ns.saturating_add(stall_ns);
                }
                // A message from a host that is not in the file comes through this host's gateway.
                if remote && !callback.is_triggered() {
                    callback.task.jitter_ns = callback.task.jitter_ns.saturating_add(stall_ns);
                    // What the gateway then catches up with comes at once.
                    callback.task.min_distance_ns = 0;
                }
            }
        }
        Some(stalled)
    }
}

/// A callback of a system file and where it runs.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CallbackEntry {
    /// Its name.
    pub name: String,
    /// The node it belongs to.
    pub node: String,
    /// The client library whose executors run that node's callbacks.
    pub client: Client,
    /// Which of its executors.
    pub executor: Executor,
    /// Name of the thread that runs it.
    pub thread: String,
    /// The group that the thread belongs to; `None` for a thread of its own.
    pub group: Option<String>,
    /// Index of its core in [`SystemFile::cores`].
    pub core: usize,
    /// SCHED_FIFO priority of the thread, 1 to 99, or [`Reservation::PRIORITY`]; with [`ThreadPriority::Callback`] the ceiling.
    pub priority: u8,
    /// Which priority the thread has while it runs the callback.
    pub thread_priority: ThreadPriority,
    /// The lowest priority at which the thread runs a callback: below `priority` at most with [`ThreadPriority::Callback`].
    pub lowest_priority: u8,
    /// Who wakes its thread.
    pub wake_up: WakeUp,
    /// Its rank in a group with `order = "priority"`: the highest of the waiting callbacks runs next. Timers have none.
    pub rank: Option<u8>,
    /// What the kernel reserves for the thread, if it runs under SCHED_DEADLINE.
    pub reservation: Option<Reservation>,
    /// Whether the thread may run on any core of its host; its messages are then charged to `core`.
    pub floats: bool,
    /// The topics that trigger it, or that it waits for; none if it has a period.
    pub topics: Vec<String>,
    /// Whether it waits for messages of all its topics.
    pub joins: bool,
    /// The policy by which it joins them, if it does.
    pub policy: JoinPolicy,
    /// What happens to a job that uses more time than the analysis charges for it.
    pub overrun: OverrunPolicy,
    /// The largest distance of their stamps, in nanoseconds: 0 for equal stamps; `None`: the newest of each topic, whatever its
    /// stamp.
    pub window_ns: Option<u64>,
    /// The topics that it publishes.
    pub publishes: Vec<String>,
    /// The smallest queue depth stated for these topics; `None` if all are `auto`.
    pub depth: Option<u64>,
    /// Latest end wanted, in nanoseconds after the arrival of the message, or after the nominal release of a period.
    pub deadline_ns: u64,
    /// The greatest size of an input that its wcet holds for, as its jobs state it; `None`: any.
    pub input_max: Option<u64>,
    /// Its tasks in [`SystemFile::system`]: one for each way that messages reach it; if it joins, before them the one that runs when
    /// all are there.
    pub tasks: Range<usize>,
}

impl CallbackEntry {
    /// SCHED_FIFO priority of the thread while it runs the callback, or [`Reservation::PRIORITY`]. It is below the ceiling, `priority`, at
    /// most with [`ThreadPriority::Callback`]; timers, which the RMW does not see, run at the ceiling.
    pub fn running_priority(&self) -> u8 {
        match self.thread_priority {
            ThreadPriority::Callback => self.rank.unwrap_or(self.priority),
            ThreadPriority::Group => self.priority,
        }
    }
}

/// Which priority the thread of a group has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ThreadPriority {
    /// The group's.
    #[default]
    Group,
    /// That of the callback that it runs. While it waits, and while timers and the executor run, it has the ceiling: the highest priority of
    /// the group's callbacks.
    Callback,
}

impl ThreadPriority {
    /// All of them.
    pub const ALL: [ThreadPriority; 2] = [ThreadPriority::Group, ThreadPriority::Callback];

    /// Its name in the file.
    pub fn as_str(self) -> &'static str {
        match self {
            ThreadPriority::Group => "group",
            ThreadPriority::Callback => "callback",
        }
    }
}

/// A topic of a system file.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct TopicEntry {
    /// Its name.
    pub name: String,
    /// Its type, such as `sensor_msgs/msg/Imu`, if the file states it.
    pub type_name: Option<String>,
    /// Its queue depth; `None`: what the analysis computes.
    pub depth: Option<u64>,
    /// Whether the file says `depth = "auto"`.
    pub is_auto: bool,
    /// Whether it goes to other hosts.
    pub remote: bool,
    /// Its priority on a busy link; `None`: by size, smaller messages first.
    pub priority: Option<LinkPriority>,
    /// Whether its messages are sent at once instead of together with those that follow shortly.
    pub express: bool,
}

/// What happens to a job that uses more time than the analysis charges for it. With every policy but the first, the bounds of
/// other callbacks do not depend on its wcet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OverrunPolicy {
    /// The overrun is counted.
    #[default]
    Tell,
    /// It continues at a priority below all real-time threads.
    Demote,
    /// It sleeps until one period after its release.
    Suspend,
    /// As `Demote`; in addition the callback ends after this job.
    End,
}

impl OverrunPolicy {
    /// All of them.
    pub const ALL: [OverrunPolicy; 4] =
        [OverrunPolicy::Tell, OverrunPolicy::Demote, OverrunPolicy::Suspend, OverrunPolicy::End];

    /// Its name in the file.
    pub fn as_str(self) -> &'static str {
        match self {
            OverrunPolicy::Tell => "tell",
            OverrunPolicy::Demote => "demote",
            OverrunPolicy::Suspend => "suspend",
            OverrunPolicy::End => "end",
        }
    }
}

/// How a callback that waits for messages of several topics finds those that belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum JoinPolicy {
    /// Chosen by its window: `ApproximateTime` with a window, equal stamps with a window of 0, the newest of
    /// each topic without a window.
    #[default]
    ByWindow,
    /// The first set whose stamps lie within the window.
    ApproximateEpsilonTime,
    /// The newest message of each topic, whenever the fastest topic has a message.
    LatestTime,
}

impl JoinPolicy {
    /// The policies that the file names.
    pub const NAMED: [JoinPolicy; 2] = [JoinPolicy::ApproximateEpsilonTime, JoinPolicy::LatestTime];

    /// Its name in the file.
    pub fn as_str(self) -> &'static str {
        match self {
            JoinPolicy::ByWindow => "by_window",
            JoinPolicy::ApproximateEpsilonTime => "approximate_epsilon_time",
            JoinPolicy::LatestTime => "latest_time",
        }
    }
}

/// The client library whose executors run a node's callbacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names say it")]
pub enum Client {
    Tautline,
    Rclcpp,
    Rclpy,
}

/// The kind of executor that runs a node's callbacks, which decides what bounds they have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[allow(missing_docs, reason = "the names say it")]
pub enum Executor {
    #[default]
    SingleThreaded,
    StaticSingleThreaded,
    MultiThreaded,
    /// An EventsExecutor or EventsCBGExecutor.
    Events,
}

impl Executor {
    /// All of them.
    pub const ALL: [Executor; 4] =
        [Executor::SingleThreaded, Executor::StaticSingleThreaded, Executor::MultiThreaded, Executor::Events];

    /// Its name in the file.
    pub fn as_str(self) -> &'static str {
        match self {
            Executor::SingleThreaded => "single-threaded",
            Executor::StaticSingleThreaded => "static-single-threaded",
            Executor::MultiThreaded => "multi-threaded",
            Executor::Events => "events",
        }
    }
}

/// Which messages go first over a link between hosts that is busy: Zenoh's priorities, the highest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs, reason = "the names say it")]
pub enum LinkPriority {
    RealTime,
    InteractiveHigh,
    InteractiveLow,
    DataHigh,
    Data,
    DataLow,
    Background,
}

impl LinkPriority {
    /// All, the highest first.
    pub const ALL: [LinkPriority; 7] = [
        LinkPriority::RealTime,
        LinkPriority::InteractiveHigh,
        LinkPriority::InteractiveLow,
        LinkPriority::DataHigh,
        LinkPriority::Data,
        LinkPriority::DataLow,
        LinkPriority::Background,
    ];

    /// Its name in the file and on the gateway's command line.
    pub fn as_str(self) -> &'static str {
        match self {
            LinkPriority::RealTime => "real_time",
            LinkPriority::InteractiveHigh => "interactive_high",
            LinkPriority::InteractiveLow => "interactive_low",
            LinkPriority::DataHigh => "data_high",
            LinkPriority::Data => "data",
            LinkPriority::DataLow => "data_low",
            LinkPriority::Background => "background",
        }
    }
}

/// A core of a host.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CoreEntry {
    /// The host's name.
    pub host: String,
    /// The core's number there.
    pub number: usize,
    /// Priority of the host's samplers.
    pub sampler_priority: u8,
    /// Longest time for which it may stall, in nanoseconds. Queues are deep enough for a stall; response-time
    /// bounds do not include it.
    pub stall_ns: u64,
    /// Whether nodes and callbacks of ROS 2 that the file does not list are refused on the host, instead of being warned of.
    pub refuses_unlisted: bool,
}

/// Who wakes the thread of a callback for a message: see docs/wake-ups.md.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WakeUp {
    /// The publisher, as always in `rmw_wait` of ROS 2's executors.
    Publisher,
    /// The sampler of its node, for this reason.
    Sampler(&'static str),
}

/// A lock that a task takes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Lock {
    pub task: usize,
    /// How many tasks from `task` on belong to its callback, one for each way that messages reach it.
    pub streams: usize,
    pub resource: String,
    pub length_ns: u64,
    pub protocol: LockProtocol,
}
