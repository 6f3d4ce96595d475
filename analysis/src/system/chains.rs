// SPDX-License-Identifier: MIT OR Apache-2.0
//! End-to-end bounds of the chains of a system.
use super::fixpoint::Outcomes;
use super::{Chain, System, Transfer};
use crate::chain::{Stage, data_age, register_sampled};
use crate::{AnalysisError, Response};

/// The end-to-end bounds of a chain, in nanoseconds.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct ChainBound {
    /// If each stage triggers the next: from the release of the first to the end of the last. Otherwise the reaction
    /// time, the sum of (T + R) (Davare et al. 2007), in which stages that trigger one another count as one.
    pub latency_ns: u64,
    /// From an event outside, just missed by the first stage, to the end of the first job that reflects it.
    pub reaction_ns: u64,
    /// How old what the first stage read may be when the last one ends a job that uses it.
    pub age_ns: u64,
    /// The deadline.
    pub deadline_ns: u64,
    /// Whether the latency is within the deadline.
    pub met: bool,
}

pub(super) fn bound(
    system: &System,
    chain: &Chain,
    outcomes: &Outcomes,
) -> Result<ChainBound, AnalysisError> {
    let count = system.callbacks.len();
    if let Some(&index) = chain.stages.iter().find(|stage| **stage >= count) {
        return Err(AnalysisError::BadReference { name: chain.name.clone(), what: "task", index, count });
    }
    let overflow = || AnalysisError::Overflow { task: chain.name.clone() };
    let mut segments: Vec<Stage> = Vec::new();
    let mut start = 0;
    for end in 1..=chain.stages.len() {
        if end < chain.stages.len() && triggers(system, chain.stages[end - 1], chain.stages[end]).is_some() {
            continue;
        }
        let latency = triggered_latency(system, &chain.stages[start..end], outcomes, true)?;
        let period_ns = outcome(outcomes, chain.stages[start])?.period_ns;
        let transfer = start.checked_sub(1).and_then(|edge| chain.transfers.get(edge));
        let transfer_ns = transfer.map_or(0, |transfer| transfer.most_ns);
        let response_ns = latency.and_then(|ns| ns.checked_add(transfer_ns)).ok_or_else(overflow)?;
        segments.push(Stage { period_ns, response_ns });
        start = end;
    }
    let reaction_ns = register_sampled(&segments).ok_or_else(overflow)?;
    let age_ns = data_age(&segments).ok_or_else(overflow)?;
    let latency_ns = match segments.len() {
        1 => {
            let own = system.callbacks[chain.stages[0]].trigger.is_none();
            triggered_latency(system, &chain.stages, outcomes, own)?.ok_or_else(overflow)?
        }
        _ => reaction_ns,
    };
    let (deadline_ns, met) = (chain.deadline_ns, latency_ns <= chain.deadline_ns);
    Ok(ChainBound { latency_ns, reaction_ns, age_ns, deadline_ns, met })
}

/// From the release of the first stage (its nominal one, or the arrival of its message) to the end of the last, where
/// each triggers the next; `None` on overflow.
///
/// The sum of all responses, or, from the nominal release of the first, what may be less: the response of the last from
/// its own nominal release, which lies the least times of all stages before it later.
fn triggered_latency(
    system: &System,
    stages: &[usize],
    outcomes: &Outcomes,
    nominal: bool,
) -> Result<Option<u64>, AnalysisError> {
    let first = outcome(outcomes, stages[0])?;
    let mut sum = Some(if nominal { first.response_ns } else { first.from_arrival_ns });
    let mut least = Some(0);
    for pair in stages.windows(2) {
        let transfer = triggers(system, pair[0], pair[1]).unwrap_or_default();
        let response_ns = outcome(outcomes, pair[1])?.from_arrival_ns;
        sum = sum.and_then(|sum: u64| sum.checked_add(response_ns)?.checked_add(transfer.most_ns));
        let shortest = system.callbacks[pair[0]].task.bcet_ns.checked_add(transfer.least_ns);
        least = least.and_then(|least: u64| least.checked_add(shortest?));
    }
    let last = outcome(outcomes, stages[stages.len() - 1])?;
    let from_nominal = least.and_then(|least| least.checked_add(last.response_ns)).filter(|_| nominal);
    Ok(sum.into_iter().chain(from_nominal).min())
}

fn triggers(system: &System, from: usize, to: usize) -> Option<Transfer> {
    system.callbacks[to].trigger.filter(|(source, _)| *source == from).map(|(_, transfer)| transfer)
}

fn outcome(outcomes: &Outcomes, index: usize) -> Result<&Response, AnalysisError> {
    outcomes[index].as_ref().map_err(Clone::clone)
}
