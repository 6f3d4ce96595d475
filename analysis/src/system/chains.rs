// SPDX-License-Identifier: MIT OR Apache-2.0
//! End-to-end bounds of the chains of a system.
use super::fixpoint::Solved;
use super::{Chain, Matching, System, Transfer, join};
use crate::chain::{Stage, data_age, register_sampled};
use crate::{AnalysisError, Response};

/// The end-to-end bounds of a chain, in nanoseconds.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct ChainBound {
    /// If each stage triggers the next: from the release of the first to the end of the last; through a join, of messages that
    /// are in a set. Otherwise the reaction
    /// time, the sum of (T + R) (Davare et al. 2007), in which stages that trigger one another count as one.
    pub latency_ns: u64,
    /// From an event outside, just missed by the first stage, to the end of the first job that reflects it. `None` if a join, by its
    /// window or its policy, may never run such a job.
    pub reaction_ns: Option<u64>,
    /// Data age: how old the input of the first stage may be when the last stage ends a job that uses it.
    pub age_ns: u64,
    /// The deadline.
    pub deadline_ns: u64,
    /// Whether the latency is within the deadline.
    pub met: bool,
}

pub(super) fn bound(system: &System, chain: &Chain, solved: &Solved) -> Result<ChainBound, AnalysisError> {
    let count = system.callbacks.len();
    if let Some(&index) = chain.stages.iter().find(|stage| **stage >= count) {
        return Err(AnalysisError::BadReference { name: chain.name.clone(), what: "task", index, count });
    }
    let overflow = || AnalysisError::Overflow { task: chain.name.clone() };
    // Stages that trigger one another are one: with a message that passes all of them, and with it or a later one.
    let (mut passing, mut reflecting): (Vec<Stage>, Result<Vec<Stage>, AnalysisError>) =
        (Vec::new(), Ok(Vec::new()));
    let mut start = 0;
    for end in 1..=chain.stages.len() {
        if end < chain.stages.len() && link(system, chain.stages[end - 1], chain.stages[end]).is_some() {
            continue;
        }
        let (period_ns, nominal) = pace(system, solved, chain, chain.stages[start])?;
        let transfer = start.checked_sub(1).and_then(|edge| chain.transfers.get(edge));
        let transfer_ns = transfer.map_or(0, |transfer| transfer.most_ns);
        let stage = |latency: Option<u64>| -> Result<Stage, AnalysisError> {
            let response_ns = latency.and_then(|ns| ns.checked_add(transfer_ns)).ok_or_else(overflow)?;
            Ok(Stage { period_ns, response_ns })
        };
        let way = Way { system, solved, chain: &chain.name, stages: &chain.stages[start..end] };
        passing.push(stage(way.latency(nominal, false)?)?);
        reflecting = reflecting.and_then(|mut stages| {
            stages.push(stage(way.latency(nominal, true)?)?);
            Ok(stages)
        });
        start = end;
    }
    let reaction = reflecting.and_then(|stages| register_sampled(&stages).ok_or_else(overflow));
    let age_ns = data_age(&passing).ok_or_else(overflow)?;
    let latency_ns = match passing.len() {
        1 => {
            let own = !system.callbacks[chain.stages[0]].is_triggered();
            let way = Way { system, solved, chain: &chain.name, stages: &chain.stages };
            way.latency(own, false)?.ok_or_else(overflow)?
        }
        _ => reaction.clone()?,
    };
    let (deadline_ns, met) = (chain.deadline_ns, latency_ns <= chain.deadline_ns);
    Ok(ChainBound { latency_ns, reaction_ns: reaction.ok(), age_ns, deadline_ns, met })
}

/// How often a stage runs at least, and whether its responses count from nominal releases: those of a join have none.
fn pace(system: &System, solved: &Solved, chain: &Chain, stage: usize) -> Result<(u64, bool), AnalysisError> {
    let response = outcome(solved, stage)?;
    let first = join::first(system, stage);
    match (&system.callbacks[first].join, solved.timings[stage].gap_ns) {
        (None, _) => Ok((response.period_ns, true)),
        // Alone it does not matter.
        (Some(_), u64::MAX) if chain.stages.len() > 1 => Err(starved(system, solved, &chain.name, first)),
        (Some(_), u64::MAX) => Ok((response.period_ns, false)),
        (Some(_), gap_ns) => Ok((gap_ns, false)),
    }
}

/// Why a join may never run.
fn starved(system: &System, solved: &Solved, chain: &str, stage: usize) -> AnalysisError {
    let name = |i: usize| system.callbacks[i].task.name.clone();
    let far = solved.joins[stage].as_ref().and_then(|bound| bound.starved_by.first());
    let (chain, task) = (chain.to_owned(), name(stage));
    let Some(join) = &system.callbacks[stage].join else { return AnalysisError::Overflow { task } };
    let taker = |far| join.inputs.get(join.ports.iter().position(|port| *port == far)?);
    let far = far.and_then(|&(far, gap_ns)| Some((*taker(far)?, gap_ns)));
    match (join.matching, far) {
        (
            Matching::Approximate { window_ns } | Matching::ApproximateEpsilon { window_ns },
            Some((far, gap_ns)),
        ) => AnalysisError::Starved { chain, task, input: name(far), window_ns, gap_ns },
        (Matching::ApproximateEpsilon { .. }, None) => AnalysisError::NotReflected {
            chain,
            task,
            problem: "with a tolerance, what belongs to the next set may be dropped with what is too early for it, if there are three \
                      inputs or more: match by a window, as ApproximateTime does",
        },
        (Matching::LatestTime, _) => AnalysisError::NotReflected {
            chain,
            task,
            problem: "messages of two inputs may come at the same rate, with their jitter and the time that it takes to take them, so that \
                      it is not known which is the fastest: let one of them trigger it, and read the others",
        },
        // Never: what starves says by what.
        _ => AnalysisError::Overflow { task },
    }
}

/// Stages each of which triggers the next.
struct Way<'a> {
    system: &'a System,
    solved: &'a Solved,
    chain: &'a str,
    stages: &'a [usize],
}

impl Way<'_> {
    /// From the release of the first stage (its nominal one, or the arrival of its message) to the end of the last; `None` on
    /// overflow. Through a join: of a message that is in a set, or until a set with it or a later one.
    ///
    /// The sum of all responses, or, from the nominal release of the first, what may be less: the response of the last from
    /// its own nominal release, which lies the least times of all stages before it later.
    fn latency(&self, nominal: bool, reflected: bool) -> Result<Option<u64>, AnalysisError> {
        let Some(&last) = self.stages.last() else { return Ok(Some(0)) };
        let response = |stage: usize| outcome(self.solved, stage);
        // What takes a message for a join leaves the rest to it.
        let joins = |at: usize| {
            let next = self.stages.get(at + 1).map(|next| link(self.system, self.stages[at], *next));
            matches!(next, Some(Some(Link::Joined(_))))
        };
        let own = |at: usize, nominal: bool| {
            let found = response(self.stages[at])?;
            Ok(match (joins(at), nominal) {
                (true, true) => found.jitter_ns,
                (true, false) => 0,
                (false, true) => found.response_ns,
                (false, false) => found.from_arrival_ns,
            })
        };
        let mut sum = Some(own(0, nominal)?);
        let mut least = Some(0);
        for (at, pair) in self.stages.windows(2).enumerate() {
            let more = own(at + 1, false)?;
            let (most, shortest) = match link(self.system, pair[0], pair[1]) {
                Some(Link::Message(transfer)) => (
                    transfer.most_ns,
                    self.system.callbacks[pair[0]].task.bcet_ns.checked_add(transfer.least_ns),
                ),
                Some(Link::Joined(input)) => {
                    (self.wait(pair[1], input, reflected)?, self.between(pair[0], pair[1]))
                }
                None => (0, Some(0)),
            };
            sum = sum.and_then(|sum: u64| sum.checked_add(more)?.checked_add(most));
            least = least.and_then(|least: u64| least.checked_add(shortest?));
        }
        let from_nominal = least.and_then(|least| least.checked_add(response(last).ok()?.response_ns));
        Ok(sum.into_iter().chain(from_nominal.filter(|_| nominal)).min())
    }

    /// How long a message of an input waits.
    fn wait(&self, stage: usize, input: usize, reflected: bool) -> Result<u64, AnalysisError> {
        let unknown = || AnalysisError::Overflow { task: self.system.callbacks[stage].task.name.clone() };
        let bound = self.solved.joins[stage].as_ref().ok_or_else(unknown)?;
        if !reflected {
            return Ok(bound.wait_ns[input]);
        }
        let reflected = bound.reflected_ns.as_ref().map(|reflected| reflected[input]);
        reflected.ok_or_else(|| starved(self.system, self.solved, self.chain, stage))
    }

    /// From the nominal release of what takes a message to that of its join, which it has in common with others by exact stamps only.
    fn between(&self, taker: usize, join: usize) -> Option<u64> {
        let matching = self.system.callbacks[join].join.as_ref()?.matching;
        let (from, to) = (self.solved.timings[taker].least_ns, self.solved.timings[join].least_ns);
        (matching == Matching::Exact).then(|| to.saturating_sub(from))
    }
}

/// What leads from a stage to the next.
enum Link {
    Message(Transfer),
    /// The next waits for a message that the first takes, as this input of it.
    Joined(usize),
}

fn link(system: &System, from: usize, to: usize) -> Option<Link> {
    let callback = &system.callbacks[to];
    if let Some((_, transfer)) = callback.trigger.filter(|(source, _)| *source == from) {
        return Some(Link::Message(transfer));
    }
    let input = callback.join.as_ref()?.inputs.iter().position(|input| *input == from)?;
    Some(Link::Joined(input))
}

fn outcome(solved: &Solved, index: usize) -> Result<&Response, AnalysisError> {
    solved.outcomes[index].as_ref().map_err(Clone::clone)
}
