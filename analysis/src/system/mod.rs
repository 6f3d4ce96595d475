// SPDX-License-Identifier: MIT OR Apache-2.0
//! Several cores and hosts: callbacks that trigger one another, and chains from end to end.
//!
//! Each core is analysed for itself. A callback that a message triggers inherits the releases of the message's
//! publisher, with jitter J + R - bcet + (longest - shortest transfer), which may lengthen response times on its core,
//! and so on: all is repeated until nothing changes any more (compositional analysis, Richter 2005). Jitter starts at
//! its least and only grows, so what is reached is the least fixed point. Within a core jitter bunches nothing: what leads to a callback at
//! its priority or above is done before that level idles, so in a busy window the callback is released as often as the first callback that
//! leads to it, and has ended when the window does (without stalls, of which another may begin as soon as a publisher has caught up). A
//! publisher that is held to its budget, or has a reservation, may publish arbitrarily late: of n messages that its queue keeps, n + 1 may
//! then come at once, as if they had that many periods of jitter. Callbacks that wait for messages of several others: [`Join`].
use crate::level::Effort;
use crate::{AnalysisError, Overheads, Release, Response, Task};

mod chains;
mod fixpoint;
mod join;
mod slack;

pub use chains::ChainBound;
pub use join::{Join, JoinBound, Matching};
pub(crate) use slack::{FEW, LIMIT, UNIT};

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

/// Why the executor of a callback gives it no bound.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unbounded {
    /// Several threads run it and others at one priority, in an order that they choose, and poll while they wait for one another.
    MultiThreaded,
    /// Another thread passes it on, and it runs in its executor's own order.
    Events,
    /// A timer of an executor that takes messages first, of which the RMW always reports more.
    TimerAfterMessages,
}

impl std::fmt::Display for Unbounded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Unbounded::MultiThreaded => {
                "the threads of a MultiThreadedExecutor run callbacks in an order of their own, and poll while they wait for one another"
            }
            Unbounded::Events => {
                "an EventsExecutor gets its messages from another thread, and runs callbacks in an order of its own"
            }
            Unbounded::TimerAfterMessages => {
                "a StaticSingleThreadedExecutor takes the messages of all priorities before it runs a timer"
            }
        })
    }
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
    fn counted_ns(&self, response: &Response) -> u64 {
        if self.is_triggered() { response.from_arrival_ns } else { response.response_ns }
    }

    fn meets(&self, response: &Response) -> bool {
        self.counted_ns(response) <= response.deadline_ns
    }

    /// The callbacks whose messages release it.
    fn predecessors(&self) -> &[usize] {
        match (&self.trigger, &self.join) {
            (Some((source, _)), _) => std::slice::from_ref(source),
            (None, Some(join)) => &join.inputs,
            (None, None) => &[],
        }
    }
}

/// What the analysis of a [`System`] found.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct SystemReport {
    /// The bound of each callback, or why it has none.
    pub callbacks: Vec<Result<Response, AnalysisError>>,
    /// The bounds of each chain, or why it has none.
    pub chains: Vec<Result<ChainBound, AnalysisError>>,
    /// For each callback that is a join, its bounds; `None` also if there is no bound.
    pub joins: Vec<Option<JoinBound>>,
    /// For each core, whether the kernel may pause its real-time threads.
    pub throttled: Vec<bool>,
    /// The number of iterations until nothing changed.
    pub rounds: u32,
}

impl SystemReport {
    /// Whether every callback and every chain meets its deadline.
    pub fn schedulable(&self) -> bool {
        let callbacks =
            self.callbacks.iter().all(|outcome| outcome.as_ref().is_ok_and(|response| response.met));
        callbacks && self.chains.iter().all(|outcome| outcome.as_ref().is_ok_and(|chain| chain.met))
    }
}

impl System {
    /// The period of a callback: its own, or the one inherited from its trigger. With several inputs it is the longest of them; with
    /// several publishers it is that of all their messages together. The system must have no cycles.
    pub fn period_ns(&self, callback: usize) -> u64 {
        join::period(self, callback)
    }

    /// The same for all callbacks.
    pub fn periods_ns(&self) -> Vec<u64> {
        join::periods(self)
    }

    /// Bounds every callback and every chain.
    ///
    /// The deadline of a triggered callback counts from the arrival of its message, that of any other from its nominal
    /// release.
    ///
    /// # Errors
    /// Faults that make the whole system meaningless: an index that does not exist, a cycle of triggers, an invalid task, a
    /// join without a meaning. The report contains the faults that leave single callbacks without a bound.
    pub fn analyse(&self) -> Result<SystemReport, AnalysisError> {
        let solved = fixpoint::solve(self, &Effort::unlimited())?;
        let chains = self.chains.iter().map(|chain| chains::bound(self, chain, &solved)).collect();
        let callbacks = solved.outcomes.into_iter().zip(&self.callbacks).map(|(outcome, callback)| {
            outcome.map(|mut response| {
                response.met = callback.meets(&response);
                response
            })
        });
        let (throttled, rounds, joins) = (solved.throttled, solved.rounds, solved.joins);
        Ok(SystemReport { callbacks: callbacks.collect(), chains, joins, throttled, rounds })
    }
}
