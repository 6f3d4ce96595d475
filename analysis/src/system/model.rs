// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is analysed: callbacks on cores, what triggers them, and the chains through them.
use crate::error::Unbounded;
use crate::{Overheads, Release, Response, Task};

/// Callbacks on the cores of one or several hosts.
///
/// ```
/// use std::time::Duration;
/// use tautline_analysis::Task;
/// use tautline_analysis::system::{Callback, Chain, Core, System, Transfer};
/// let ms = Duration::from_millis;
/// let driver = Callback::new(Task::new("driver", ms(10), ms(2), 20), 0);
/// let planner = Callback::new(Task::new("planner", ms(10), ms(4), 19), 1).triggered_by(0, Transfer::LOCAL);
/// let chain = Chain { deadline_ns: 10_000_000, ..Chain::new("scan to plan", vec![0, 1]) };
/// let system = System { cores: vec![Core::default(); 2], callbacks: vec![driver, planner], chains: vec![chain], ..System::default() };
/// let report = system.analyse()?;
/// assert_eq!(report.chains[0].as_ref().unwrap().latency_ns, 6_000_000);
/// assert!(report.schedulable());
/// # Ok::<(), tautline_analysis::AnalysisError>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct System {
    /// The cores of all hosts.
    pub cores: Vec<Core>,
    /// What runs on them.
    pub callbacks: Vec<Callback>,
    /// The additional work of relays for their messages.
    pub relays: Vec<Relay>,
    /// Paths through the callbacks whose end-to-end time matters.
    pub chains: Vec<Chain>,
}

/// One core.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Core {
    /// The overheads of the machine and the middleware there.
    pub overheads: Overheads,
    /// How long it may stall, if that is counted: the blocking of its tasks contains the stall; work that piled up then is done at once.
    pub stall_ns: u64,
}

/// Work of the highest priority for each message of a callback, or from outside: that of a gateway.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Relay {
    /// Index of the core that does it.
    pub core: usize,
    /// The callback whose messages they are, and their transfer to this core; `None` from outside.
    pub source: Option<(usize, Transfer)>,
    /// When they come from outside.
    pub release: Release,
    /// Its time for one message.
    pub cost_ns: u64,
}

/// A task on a core.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Callback {
    /// Its task; if something triggers it, inherited values replace its period, trace and jitter.
    pub task: Task,
    /// Index of its core.
    pub core: usize,
    /// The index of the callback that triggers it, and the transfer of the message; `None` if it has releases of its own, or
    /// is a join.
    pub trigger: Option<(usize, Transfer)>,
    /// Its join, if it needs messages of several others; inherited values then replace its period, trace and
    /// jitter.
    pub join: Option<Join>,
    /// The callback of which this is a copy on another core: a callback that may run on any core has the worst of the bounds.
    pub copy_of: Option<usize>,
    /// Why its executor gives it no bound, if it gives none.
    pub unbounded: Option<Unbounded>,
}

/// The time that a message takes from the end of one callback to the release of another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Transfer {
    /// The shortest time.
    pub least_ns: u64,
    /// The longest time.
    pub most_ns: u64,
}

/// A path through callbacks.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Chain {
    /// Name used in results and errors.
    pub name: String,
    /// Its parts in their order. Each but the first reads the latest value of the one before, at its own pace.
    pub parts: Vec<Part>,
    /// Longest end-to-end time wanted.
    pub deadline_ns: u64,
}

/// The stages of a chain that trigger one another.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Part {
    /// The ways through it, as indices of callbacks: one for each trigger of the first stage, and each publication of a stage.
    pub ways: Vec<Vec<usize>>,
    /// The transfer of the value that the first stage reads.
    pub transfer: Transfer,
    /// The other callback that writes the value, and may overwrite what this chain passes on; `None` if there is none.
    pub overwritten_by: Option<String>,
}

impl Chain {
    /// Through these callbacks of one host. Where one does not trigger the next, the next reads the latest value, which only that one writes.
    pub fn new(name: impl Into<String>, stages: Vec<usize>) -> Self {
        let part = Part { ways: vec![stages], ..Part::default() };
        Self { name: name.into(), parts: vec![part], deadline_ns: u64::MAX }
    }
}

impl Transfer {
    /// Within a host, where the transfer is part of the overhead of each message.
    pub const LOCAL: Self = Self { least_ns: 0, most_ns: 0 };
}

impl Callback {
    /// A callback with releases of its own.
    pub fn new(task: Task, core: usize) -> Self {
        Self { task, core, trigger: None, join: None, copy_of: None, unbounded: None }
    }

    /// Makes the messages of another callback trigger this one.
    #[must_use = "it returns the changed Callback"]
    pub fn triggered_by(mut self, callback: usize, transfer: Transfer) -> Self {
        self.trigger = Some((callback, transfer));
        self
    }

    /// Makes it run once messages of several others are there. `inputs` are the callbacks that take these
    /// messages.
    #[must_use = "it returns the changed Callback"]
    pub fn joining(self, inputs: Vec<usize>, matching: Matching) -> Self {
        let ports = (0..inputs.len()).collect();
        self.joining_ports(inputs, ports, matching)
    }

    /// The same, where several of these callbacks may take the messages of one input: see [`Join::ports`].
    #[must_use = "it returns the changed Callback"]
    pub fn joining_ports(mut self, inputs: Vec<usize>, ports: Vec<usize>, matching: Matching) -> Self {
        self.join = Some(Join { inputs, ports, matching });
        self
    }

    /// Whether messages of the system release it, not a period of its own.
    pub fn is_triggered(&self) -> bool {
        self.trigger.is_some() || self.join.is_some()
    }

    /// Returns the response that its deadline applies to.
    pub(super) fn counted_ns(&self, response: &Response) -> u64 {
        if self.is_triggered() { response.from_arrival_ns } else { response.response_ns }
    }

    pub(super) fn meets(&self, response: &Response) -> bool {
        self.counted_ns(response) <= response.deadline_ns
    }

    /// The callbacks whose messages release it.
    pub(super) fn predecessors(&self) -> &[usize] {
        match (&self.trigger, &self.join) {
            (Some((source, _)), _) => std::slice::from_ref(source),
            (None, Some(join)) => &join.inputs,
            (None, None) => &[],
        }
    }
}

/// A callback that runs once it has messages of several others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Join {
    /// Indices of the callbacks that take the messages, one for each stream, in its thread. They are triggered by the
    /// publisher, or released from outside, and store the message.
    pub inputs: Vec<usize>,
    /// For each of these, the input of the join whose messages it takes, from 0: an input may have several
    /// publishers.
    pub ports: Vec<usize>,
    /// Which messages belong together.
    pub matching: Matching,
}

/// Which messages of a join belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Matching {
    /// The newest message of each input, as soon as each input has a new one.
    Newest,
    /// The newest of the messages that were taken, where each run takes one message: the way of ROS 2's executors.
    NewestTaken,
    /// Messages with equal stamps: they all descend from one source, or from several sources that are
    /// released together.
    Exact,
    /// Messages whose stamps lie within a window, by message_filters' `ApproximateTime`.
    Approximate {
        /// The longest distance of two stamps of a set, in nanoseconds.
        window_ns: u64,
    },
    /// The first messages whose stamps lie within a window, by message_filters' `ApproximateEpsilonTime`.
    ApproximateEpsilon {
        /// The longest distance of two stamps of a set, in nanoseconds.
        window_ns: u64,
    },
    /// The newest message of each input, whenever the fastest input has a message, by message_filters'
    /// `LatestTime`.
    LatestTime,
}

impl Matching {
    /// Whether a set has the newest of each input, whatever the stamps.
    pub(crate) fn is_newest(self) -> bool {
        matches!(self, Matching::Newest | Matching::NewestTaken)
    }
}
