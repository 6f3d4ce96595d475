// SPDX-License-Identifier: MIT OR Apache-2.0
//! The callbacks that chains pass.
use std::collections::HashMap;

use super::declared::{Chain, Declared};
use super::graph::Graph;
use super::problem::Collector;
use super::streams::Streams;
use crate::system::Callback;

/// Checks that every stage exists and takes something from the one before.
pub(super) fn check(graph: &Graph<'_>, problems: &Collector) {
    let file = graph.file;
    for (i, chain) in file.chains.iter().enumerate() {
        if file.chains[..i].iter().any(|other| other.name == chain.name) {
            problems.at(chain.at).add(format!("there are two chains called `{}`: rename one", chain.name));
        }
        let names = || file.callbacks.iter().map(|callback| callback.name.as_str());
        for stage in &chain.path {
            if !names().any(|name| name == stage.value) {
                let hint = problems.suggestion(&stage.value, names());
                problems.at(stage.at).add(format!(
                    "chain `{}` passes callback `{}`, which does not exist{hint}",
                    chain.name, stage.value
                ));
            }
        }
        for pair in chain.path.windows(2) {
            let find = |name: &str| file.callbacks.iter().find(|callback| callback.name == name);
            let (Some(from), Some(to)) = (find(&pair[0].value), find(&pair[1].value)) else { continue };
            let takes = |topic: &str| to.topics.iter().chain(&to.reads).any(|taken| taken.value == topic);
            if !from.publishes.iter().any(|topic| takes(&topic.value)) {
                problems.at(pair[1].at).add(format!(
                    "chain `{}` goes from `{}` to `{}`, which neither is triggered by nor reads a topic that `{}` \
                     publishes: correct the path, or the topics",
                    chain.name, from.name, to.name, from.name
                ));
            }
        }
    }
}

/// The callbacks of a chain without problems, by index.
pub(super) fn resolve(file: &Declared, chain: &Chain) -> Vec<usize> {
    let index = |name: &str| file.callbacks.iter().position(|callback| callback.name == name);
    chain.path.iter().filter_map(|stage| index(&stage.value)).collect()
}

/// Maximum of ways through the joins of a chain, whose number doubles with each join of two topics of one publisher.
const MOST_WAYS: usize = 4_096;

/// Callbacks of a chain each of which triggers the next.
pub(super) struct Ways {
    /// How many callbacks.
    pub callbacks: usize,
    /// All ways through their streams, as indices of tasks.
    pub tasks: Vec<Vec<usize>>,
}

/// Returns the parts of a chain. The same message passes all of a part, where one callback triggers the next, or the next waits for it and
/// others. A callback that reads at its own pace begins another part, with any of its streams.
///
/// # Errors
/// The chain has more than [`MOST_WAYS`].
pub(super) fn parts(
    chain: &str,
    stages: &[usize],
    streams: &Streams,
    callbacks: &[Callback],
) -> Result<Vec<Ways>, String> {
    let mut parts: Vec<Ways> = Vec::new();
    for &stage in stages {
        // The triggered tasks, by the task that publishes.
        let mut triggered: HashMap<usize, Vec<usize>> = HashMap::new();
        for to in streams.tasks(stage) {
            if let Some((from, _)) = callbacks[to].trigger {
                triggered.entry(from).or_default().push(to);
            }
        }
        // A task that takes a message for a join passes it on to the join.
        let join = streams.outputs(stage).next().filter(|_| streams.is_join(stage));
        let extend = |path: &Vec<usize>| -> Vec<Vec<usize>> {
            let next = path.last().and_then(|from| triggered.get(from)).into_iter().flatten();
            next.map(|to| path.iter().copied().chain([*to]).chain(join).collect()).collect()
        };
        let former = parts.last().into_iter().flat_map(|part| &part.tasks);
        let further: Vec<_> = former.flat_map(extend).take(MOST_WAYS + 1).collect();
        if further.len() > MOST_WAYS {
            return Err(format!(
                "chain `{chain}` has more than {MOST_WAYS} ways through its joins: split it into several chains"
            ));
        }
        match parts.last_mut().filter(|_| !further.is_empty()) {
            Some(part) => *part = Ways { callbacks: part.callbacks + 1, tasks: further },
            None => parts
                .push(Ways { callbacks: 1, tasks: streams.outputs(stage).map(|task| vec![task]).collect() }),
        }
    }
    Ok(parts)
}
