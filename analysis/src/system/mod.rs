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
use crate::{AnalysisError, Response};

mod chains;
mod fixpoint;
mod join;
mod model;
mod slack;

pub use crate::error::Unbounded;
pub use chains::ChainBound;
pub use join::JoinBound;
pub use model::{Callback, Chain, Core, Join, Matching, Part, Relay, System, Transfer};
pub(crate) use slack::{FEW, LIMIT, UNIT};

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
