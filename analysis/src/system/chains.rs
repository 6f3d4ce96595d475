// SPDX-License-Identifier: MIT OR Apache-2.0
//! End-to-end bounds of the chains of a system.
use super::fixpoint::Solved;
use super::join;
use super::model::{Chain, Matching, Part, System, Transfer};
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
    let mut stages = chain.parts.iter().flat_map(|part| &part.ways).flatten();
    if let Some(&index) = stages.find(|stage| **stage >= count) {
        return Err(AnalysisError::BadReference { name: chain.name.clone(), what: "task", index, count });
    }
    let overflow = || AnalysisError::Overflow { task: chain.name.clone() };
    let parts = split(system, &chain.parts);
    let add = |sum: u64, more: Option<u64>| more.and_then(|more| sum.checked_add(more)).ok_or_else(overflow);
    let (mut latency_ns, mut age_ns, mut reaction) = (0, 0, Ok(0));
    for (at, part) in parts.iter().enumerate() {
        let (is_first, is_last) = (at == 0, at + 1 == parts.len());
        let (mut passing, mut aging, mut reflecting) = (0, 0, Vec::new());
        for way in part.ways.iter().filter(|way| !way.is_empty()) {
            let stages = Way { system, solved, chain: &chain.name, stages: way };
            let (period_ns, nominal) = pace(system, solved, way[0])?;
            let age = |ns: u64| period_ns.unwrap_or(u64::MAX).checked_add(ns);
            // A chain of one part counts from the message that arrives; otherwise from the event that the first stage just misses.
            let own = nominal && (parts.len() > 1 || !system.callbacks[way[0]].is_triggered());
            passing = passing.max(stages.latency(own, Seen::Itself)?.ok_or_else(overflow)?);
            let used = if is_last {
                stages.latency(nominal, Seen::Itself)?
            } else {
                stages.latency(nominal, Seen::Reflected)?.and_then(age)
            };
            aging = aging.max(used.ok_or_else(overflow)?);
            reflecting.push(reflected(&stages, period_ns, nominal));
        }
        // What overwrites the value reflects nothing of the chain, unless it is of the stage that reads it.
        if let Some(other) = &part.overwritten_by {
            let (chain, other) = (chain.name.clone(), other.clone());
            reflecting = vec![Err(AnalysisError::Overwritten { chain, other })];
        }
        // An event may come by any way of the first part; what it wrote is read by each of the next.
        let reflected = if is_first {
            reflecting.into_iter().try_fold(0, |longest, next| Ok(longest.max(next?)))
        } else {
            let mut found = reflecting.into_iter();
            let first = found.next().unwrap_or(Ok(0));
            found.fold(first, |least, next| match (least, next) {
                (Ok(least), Ok(next)) => Ok(least.min(next)),
                (Err(_), next) => next,
                (least, Err(_)) => least,
            })
        };
        let transfer_ns = Some(part.transfer.most_ns);
        let (older_ns, later_ns) =
            at.checked_sub(1).map_or(Ok((0, 0)), |before| overtaken(system, solved, &parts[before], part))?;
        age_ns = add(age_ns, Some(older_ns))?;
        reaction = reaction.and_then(|sum| add(sum, Some(later_ns)));
        latency_ns = add(add(latency_ns, Some(passing))?, transfer_ns)?;
        age_ns = add(add(age_ns, Some(aging))?, transfer_ns)?;
        reaction = reaction.and_then(|sum| add(add(sum, Some(reflected?))?, transfer_ns));
    }
    if parts.len() > 1 {
        latency_ns = reaction.clone()?;
    }
    let (deadline_ns, met) = (chain.deadline_ns, latency_ns <= chain.deadline_ns);
    Ok(ChainBound { latency_ns, reaction_ns: reaction.ok(), age_ns, deadline_ns, met })
}

/// How much older a value may be that is read, and how much later it is reflected, where the network may let an older one overtake it: on its way
/// to the reader, or on that of the message from which it is made.
///
/// The last value to arrive was sent no more than the network's spread before any other that is there, so what it is made of is older by that
/// spread and by what the times from release to publication differ. An older one may overwrite the value; the
/// next that is sent a spread later comes after all of these.
fn overtaken(system: &System, solved: &Solved, from: &Part, to: &Part) -> Result<(u64, u64), AnalysisError> {
    let spread_ns = to.transfer.most_ns.saturating_sub(to.transfer.least_ns);
    let (mut older_ns, mut later_ns): (u64, u64) = (0, 0);
    for way in from.ways.iter().filter(|way| !way.is_empty()) {
        let last = way[way.len() - 1];
        if spread_ns == 0 && !solved.tasks[last].unordered {
            continue;
        }
        let writer = &system.callbacks[last].task;
        let response = outcome(solved, last)?;
        let period_ns = pace(system, solved, way[0])?.0.unwrap_or(u64::MAX);
        let late_ns = response.response_ns.saturating_sub(writer.bcet_ns);
        if writer.is_held() || late_ns.saturating_add(spread_ns) >= response.period_ns {
            let spread_ns = spread_ns.saturating_add(late_ns);
            older_ns = older_ns.max(spread_ns);
            later_ns = later_ns.max(spread_ns.saturating_add(period_ns));
        }
    }
    Ok((older_ns, later_ns))
}

/// Returns the parts, each with stages that trigger one another; a part with one way is split into these here.
fn split(system: &System, parts: &[Part]) -> Vec<Part> {
    let mut split = Vec::with_capacity(parts.len());
    for part in parts {
        let [way] = &part.ways[..] else {
            split.push(part.clone());
            continue;
        };
        let mut pieces = way.chunk_by(|from, to| link(system, *from, *to).is_some());
        split.push(Part { ways: pieces.next().into_iter().map(<[usize]>::to_vec).collect(), ..part.clone() });
        split.extend(pieces.map(|piece| Part { ways: vec![piece.to_vec()], ..Part::default() }));
    }
    split
}

/// From an event that the first stage just misses to the end of the first job that reflects it.
fn reflected(way: &Way<'_>, period_ns: Option<u64>, nominal: bool) -> Result<u64, AnalysisError> {
    let first = join::first(way.system, way.stages[0]);
    let period_ns = period_ns.ok_or_else(|| starved(way.system, way.solved, way.chain, first))?;
    let latency = way.latency(nominal, Seen::Reflected)?;
    latency
        .and_then(|ns| ns.checked_add(period_ns))
        .ok_or_else(|| AnalysisError::Overflow { task: way.chain.to_owned() })
}

/// Returns the longest distance of two runs of a stage, if bounded, and whether its responses count from nominal releases; a join's do not.
fn pace(system: &System, solved: &Solved, stage: usize) -> Result<(Option<u64>, bool), AnalysisError> {
    let response = outcome(solved, stage)?;
    let first = join::first(system, stage);
    Ok(match (&system.callbacks[first].join, solved.timings[stage].gap_ns) {
        (None, _) => (Some(response.period_ns), true),
        (Some(_), gap_ns) => (Some(gap_ns).filter(|gap_ns| *gap_ns < u64::MAX), false),
    })
}

/// The job at whose end a latency ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Seen {
    /// The job of the release itself; through a join, that of a message that is in a set.
    Itself,
    /// Through a join, that of a set with the message or a later one; of a timer, that of its release or a later one.
    Reflected,
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
        // Unreachable: other joins that starve state by which input.
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
    /// overflow.
    ///
    /// The sum of all responses, or, from the nominal release of the first, what may be less: the response of the last from
    /// its own nominal release, which lies the least times of all stages before it later.
    fn latency(&self, nominal: bool, seen: Seen) -> Result<Option<u64>, AnalysisError> {
        let Some(&last) = self.stages.last() else { return Ok(Some(0)) };
        let response = |stage: usize| outcome(self.solved, stage);
        // Of a timer whose releases are queued behind other work, only the newest release is served.
        let first = response(self.stages[0])?;
        let skips = seen != Seen::Itself && !self.system.callbacks[self.stages[0]].is_triggered();
        let is_late = skips && first.reflected_ns > first.response_ns;
        // A task that takes a message for a join leaves the rest to the join.
        let joins = |at: usize| {
            let next = self.stages.get(at + 1).map(|next| link(self.system, self.stages[at], *next));
            matches!(next, Some(Some(Link::Joined(_))))
        };
        let own = |at: usize, nominal: bool| {
            let found = response(self.stages[at])?;
            Ok(match (joins(at), nominal) {
                (true, true) => found.jitter_ns,
                (true, false) => 0,
                (false, true) if skips && at == 0 => found.reflected_ns,
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
                    (self.wait(pair[1], input, seen == Seen::Reflected)?, self.between(pair[0], pair[1]))
                }
                None => (0, Some(0)),
            };
            sum = sum.and_then(|sum: u64| sum.checked_add(more)?.checked_add(most));
            least = least.and_then(|least: u64| least.checked_add(shortest?));
        }
        let from_nominal = least.and_then(|least| least.checked_add(response(last).ok()?.response_ns));
        Ok(sum.into_iter().chain(from_nominal.filter(|_| nominal && !is_late)).min())
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

    /// From the nominal release of a task that takes messages to that of its join, which only a join by exact stamps has.
    fn between(&self, taker: usize, join: usize) -> Option<u64> {
        let matching = self.system.callbacks[join].join.as_ref()?.matching;
        let (from, to) = (self.solved.timings[taker].least_ns, self.solved.timings[join].least_ns);
        (matching == Matching::Exact).then(|| to.saturating_sub(from))
    }
}

/// The link from a stage to the next.
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
