// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that wait for messages of several others: when they run, how long a message waits, how many wait.
//!
//! Symbols, for input i of a join: its stream has period T_i, nominal releases r_i(n), and each message arrives within
//! [`least_i`, `most_i`] after its own, where most - least is the jitter J_i. What a message waits for is its *activation*,
//! the arrival of the last message that is needed; the join's response time counts from there. R is the longest response of
//! the join's thread. Messages come at their period, none is lost, and everyone has begun to send.
//!
//! **Newest of each** ([`Matching::Newest`]). It runs once everyone has sent something new. Each activation but the first is
//! preceded by a message of every input since the one before, so m of them span at least m - 1 messages of the slowest: a
//! stream with its T and jitter J + T. A message waits at most for the longest gap of another input, T_j + J_j.
//!
//! **Exact stamps** ([`Matching::Exact`]). The inputs have their nominal releases in common, and messages with the same
//! n meet. The n-th activation lies within [max least, max most] after r(n); a message waits at most max most - `least_i`.
//!
//! **Close stamps** ([`Matching::Approximate`], message_filters' policy with a window w). A stamp is taken within S_i after
//! its nominal release. Stamps are at most G_i = T_i + S_i apart and processed within D_i = most_i + R after they were taken.
//! A set is passed on at the latest when each input has sent something later than the set's pivot p, that is by
//! p + max(G + D); its stamps are no earlier than p - w. So
//!
//! ```text
//! from a stamp to the activation of its set            L = w + max(G + D)
//! messages of i that wait: its stamps within           w + max(G + D)
//! activations: the stream of each input, delayed by up to L: the slowest one's T with jitter S + L
//! ```
//!
//! If w is at least all gaps but the longest, G*, sets never starve: the latest of the oldest messages after a set that ends
//! before x is by x + G* + max(w, G*) at the latest the pivot of the next (dropping early messages moves the latest of the
//! oldest only where the slowest input is dropped, to G* after what was dropped, which was w before the latest). So a message
//! with stamp x, or a later one of its input, is in a set by x + G* + max(w, G*) + max(G + D). RTSS 2023 (Li et al.,
//! 'Worst-Case Latency Analysis of Message Synchronization in ROS') and RTCSA 2024 (Wu et al.) analyse the same policy, with
//! predicted arrivals and without windows; the bounds above are for windows and jitter, and checked against the policy itself.
use super::System;
use crate::{AnalysisError, Release, Task};

/// What makes a callback run once it has messages of several others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Join {
    /// Indices of the callbacks that take the messages, one for each input, in its thread. They are triggered by who
    /// publishes, or released from outside, and put the message aside.
    pub inputs: Vec<usize>,
    /// Which messages belong together.
    pub matching: Matching,
}

/// Which messages of a join belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Matching {
    /// The newest of each, as soon as each has sent something new.
    Newest,
    /// Those with equal stamps: one source has them all triggered, or several that are released together.
    Exact,
    /// Those whose stamps lie within a window, by message_filters' `ApproximateTime`.
    Approximate {
        /// The longest distance of two stamps of a set, in nanoseconds.
        window_ns: u64,
    },
}

/// What is known of a join once everyone sends, all in nanoseconds.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct JoinBound {
    /// For each input: from the arrival of a message that is in a set to that of the last one of the set.
    pub wait_ns: Vec<u64>,
    /// For each input: as [`wait_ns`](Self::wait_ns), to that of a set with this message or a later one of its input. `None`:
    /// the window is so short that sets may never come together.
    pub reflected_ns: Option<Vec<u64>>,
    /// How many messages of one input wait at most (of exact stamps: how many different ones), one that arrives not included.
    pub queue_size: u64,
    /// Which inputs may be further apart than the window, if sets may never come together: all but the slowest of these.
    pub starved_by: Vec<usize>,
}

/// How the releases of a callback lie to those of what triggers it first.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Timing {
    /// The least time from the nominal release of the first to one of this.
    pub least_ns: u64,
    /// The longest time between two releases.
    pub gap_ns: u64,
    /// How late after its nominal release the first takes a stamp.
    pub stamp_ns: u64,
}

impl Timing {
    /// Of a callback with releases of its own. A message from outside was stamped before it came.
    pub fn of_own(task: &Task) -> Self {
        let gap_ns = task.period_ns.saturating_add(task.jitter_ns);
        Timing { least_ns: 0, gap_ns, stamp_ns: task.jitter_ns }
    }

    /// Of a callback that `source` triggers. The first of all may take the stamp until it ends, after `stamped_ns`.
    pub fn passed_on(
        self,
        source: &Task,
        task: &Task,
        least_transfer_ns: u64,
        stamped_ns: Option<u64>,
    ) -> Self {
        let least_ns = self.least_ns.saturating_add(source.bcet_ns).saturating_add(least_transfer_ns);
        let more = task.jitter_ns.saturating_sub(source.jitter_ns);
        let stamp_ns = stamped_ns.unwrap_or(self.stamp_ns);
        Timing { least_ns, gap_ns: self.gap_ns.saturating_add(more), stamp_ns }
    }
}

/// An input of a join.
struct Input<'a> {
    task: &'a Task,
    timing: Timing,
    most_ns: u64,
    /// From its arrival to the end of what its thread does with it.
    response_ns: u64,
}

impl Input<'_> {
    /// The longest distance of two stamps.
    fn stamp_gap_ns(&self) -> u64 {
        self.task.period_ns.saturating_add(self.timing.stamp_ns)
    }

    /// From the stamp to the end of what is done with it.
    fn processed_ns(&self) -> u64 {
        self.most_ns.saturating_add(self.response_ns)
    }
}

/// How a join is released, what waits there, and how it lies to the nominal releases of its inputs.
pub(super) fn solve(
    join: &Join,
    tasks: &[Task],
    timings: &[Timing],
    response_ns: impl Fn(usize) -> u64,
) -> (Release, Timing, JoinBound) {
    let input = |i: &usize| {
        let (task, timing) = (&tasks[*i], timings[*i]);
        let most_ns = timing.least_ns.saturating_add(task.jitter_ns);
        Input { task, timing, most_ns, response_ns: response_ns(*i) }
    };
    let inputs: Vec<Input<'_>> = join.inputs.iter().map(input).collect();
    match join.matching {
        Matching::Newest => newest(&inputs),
        Matching::Exact => exact(&inputs),
        Matching::Approximate { window_ns } => approximate(&inputs, window_ns),
    }
}

fn most(inputs: &[Input<'_>], of: impl Fn(&Input<'_>) -> u64) -> u64 {
    inputs.iter().map(of).max().unwrap_or(0)
}

/// The slowest input's period, with the least of what `jitter` says of those that are as slow.
fn slowest(inputs: &[Input<'_>], jitter: impl Fn(&Input<'_>) -> u64) -> Release {
    let period_ns = most(inputs, |input| input.task.period_ns);
    let slow = inputs.iter().filter(|input| input.task.period_ns == period_ns);
    Release::periodic(period_ns).jitter(slow.map(jitter).min().unwrap_or(0))
}

fn newest(inputs: &[Input<'_>]) -> (Release, Timing, JoinBound) {
    let release = slowest(inputs, |input| input.task.jitter_ns.saturating_add(input.task.period_ns));
    let apart = inputs.iter().map(|input| input.task.min_distance_ns).min().unwrap_or(0);
    let others = |i: usize| inputs.iter().enumerate().filter(move |(j, _)| *j != i);
    let wait = |i| others(i).map(|(_, input)| input.timing.gap_ns).max().unwrap_or(0);
    let wait_ns: Vec<u64> = (0..inputs.len()).map(wait).collect();
    let timing = Timing { gap_ns: most(inputs, |input| input.timing.gap_ns), ..Timing::default() };
    let bound =
        JoinBound { reflected_ns: Some(wait_ns.clone()), wait_ns, queue_size: 1, starved_by: Vec::new() };
    (release.min_distance(apart), timing, bound)
}

fn exact(inputs: &[Input<'_>]) -> (Release, Timing, JoinBound) {
    let least_ns = most(inputs, |input| input.timing.least_ns);
    let most_ns = most(inputs, |input| input.most_ns);
    let jitter_ns = most_ns.saturating_sub(least_ns);
    let wait_ns: Vec<u64> =
        inputs.iter().map(|input| most_ns.saturating_sub(input.timing.least_ns)).collect();
    let period_ns = most(inputs, |input| input.task.period_ns);
    let first = inputs.iter().map(|input| input.timing.least_ns).min().unwrap_or(0);
    let waits = most(inputs, |input| input.processed_ns()).saturating_sub(first);
    let timing = Timing {
        least_ns,
        gap_ns: period_ns.saturating_add(jitter_ns),
        stamp_ns: most(inputs, |input| input.timing.stamp_ns),
    };
    let bound = JoinBound {
        reflected_ns: Some(wait_ns.clone()),
        wait_ns,
        queue_size: Release::periodic(period_ns).most_within(waits.saturating_add(1)).max(1),
        starved_by: Vec::new(),
    };
    (Release::periodic(period_ns).jitter(jitter_ns), timing, bound)
}

fn approximate(inputs: &[Input<'_>], window_ns: u64) -> (Release, Timing, JoinBound) {
    // Of the activation itself, which is an arrival, and of the end of what the thread does with it.
    let arrived = most(inputs, |input| input.stamp_gap_ns().saturating_add(input.most_ns));
    let processed = most(inputs, |input| input.stamp_gap_ns().saturating_add(input.processed_ns()));
    let activated = window_ns.saturating_add(arrived);
    // An arrival is at least `least` after its nominal release, a stamp at most S.
    let from_arrival = |from_stamp: u64| -> Vec<u64> {
        let of = |input: &Input<'_>| {
            from_stamp.saturating_add(input.timing.stamp_ns).saturating_sub(input.timing.least_ns)
        };
        inputs.iter().map(of).collect()
    };
    let slow = (0..inputs.len()).max_by_key(|i| inputs[*i].stamp_gap_ns()).unwrap_or(0);
    let longest = most(inputs, |input| input.stamp_gap_ns());
    let starved_by: Vec<usize> =
        (0..inputs.len()).filter(|i| *i != slow && inputs[*i].stamp_gap_ns() > window_ns).collect();
    let reflected = longest.saturating_add(window_ns.max(longest)).saturating_add(arrived);
    let held = window_ns.saturating_add(processed).saturating_add(1);
    let waiting = |input: &Input<'_>| {
        Release::periodic(input.task.period_ns).jitter(input.timing.stamp_ns).most_within(held)
    };
    let gap = inputs.iter().map(Input::stamp_gap_ns).min().unwrap_or(0);
    let bound = JoinBound {
        wait_ns: from_arrival(activated),
        reflected_ns: starved_by.is_empty().then(|| from_arrival(reflected)),
        queue_size: most(inputs, waiting).max(1),
        starved_by,
    };
    let release = slowest(inputs, |input| input.timing.stamp_ns.saturating_add(activated));
    // Where sets may starve, nothing that waits for this one has a bound.
    let gap_ns = if bound.reflected_ns.is_some() { gap.saturating_add(reflected) } else { u64::MAX };
    (release, Timing { gap_ns, ..Timing::default() }, bound)
}

/// Refuses what has no meaning.
pub(super) fn validate(system: &System, join: &Join, name: &str) -> Result<(), AnalysisError> {
    let problem = |problem| Err(AnalysisError::BadJoin { task: name.to_owned(), problem });
    if join.inputs.len() < 2 {
        return problem("it has fewer than two inputs");
    }
    if join.inputs.iter().any(|i| system.callbacks[*i].join.is_some()) {
        return problem("an input is a join itself, where a callback has to take its messages");
    }
    let periods: Vec<u64> = join.inputs.iter().map(|i| period(system, *i)).collect();
    if join.matching == Matching::Exact && periods.windows(2).any(|pair| pair[0] != pair[1]) {
        return problem("its inputs have different periods, so that most stamps have no equal");
    }
    let by_stamp = join.matching != Matching::Newest;
    if by_stamp && join.inputs.iter().any(|i| system.callbacks[first(system, *i)].join.is_some()) {
        return problem("an input comes from a join, so that its stamps are not known");
    }
    Ok(())
}

/// Who is released first of those that trigger one another down to this callback: one with releases of its own, or a join
/// whose messages are of several stamps.
pub(super) fn first(system: &System, mut index: usize) -> usize {
    loop {
        let callback = &system.callbacks[index];
        match (&callback.trigger, &callback.join) {
            (Some((source, _)), _) => index = *source,
            (None, Some(Join { inputs, matching: Matching::Exact })) => index = inputs[0],
            _ => return index,
        }
    }
}

/// The period that a callback inherits.
pub(super) fn period(system: &System, index: usize) -> u64 {
    let callback = &system.callbacks[index];
    match (&callback.trigger, &callback.join) {
        (Some((source, _)), _) => period(system, *source),
        (None, Some(join)) => join.inputs.iter().map(|i| period(system, *i)).max().unwrap_or(0),
        (None, None) => callback.task.period_ns,
    }
}
