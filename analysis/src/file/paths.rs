// SPDX-License-Identifier: MIT OR Apache-2.0
//! The callbacks that chains pass.
use super::declared::{Chain, Declared};
use super::graph::Graph;
use super::problem::{Collector, suggestion};
use super::streams::Streams;
use crate::system::Callback;

/// Checks that every stage exists and takes something from the one before.
pub(super) fn check(graph: &Graph<'_>, problems: &mut Collector) {
    let file = graph.file;
    for (i, chain) in file.chains.iter().enumerate() {
        if file.chains[..i].iter().any(|other| other.name == chain.name) {
            problems.add(chain.at, format!("there are two chains called `{}`: rename one", chain.name));
        }
        let names = || file.callbacks.iter().map(|callback| callback.name.as_str());
        for stage in &chain.path {
            if !names().any(|name| name == stage.value) {
                let hint = suggestion(&stage.value, names());
                problems.add(
                    stage.at,
                    format!(
                        "chain `{}` passes callback `{}`, which does not exist{hint}",
                        chain.name, stage.value
                    ),
                );
            }
        }
        for pair in chain.path.windows(2) {
            let find = |name: &str| file.callbacks.iter().find(|callback| callback.name == name);
            let (Some(from), Some(to)) = (find(&pair[0].value), find(&pair[1].value)) else { continue };
            let takes = |topic: &str| to.topics.iter().chain(&to.reads).any(|taken| taken.value == topic);
            if !from.publishes.iter().any(|topic| takes(&topic.value)) {
                problems.add(
                    pair[1].at,
                    format!(
                        "chain `{}` goes from `{}` to `{}`, which neither is \
                     triggered by nor reads a topic that `{}` publishes: correct the path, or the \
                     topics",
                        chain.name, from.name, to.name, from.name
                    ),
                );
            }
        }
    }
}

/// The callbacks of a chain without problems, by index.
pub(super) fn resolve(file: &Declared, chain: &Chain) -> Vec<usize> {
    let index = |name: &str| file.callbacks.iter().position(|callback| callback.name == name);
    chain.path.iter().filter_map(|stage| index(&stage.value)).collect()
}

/// All ways through the streams of these callbacks, as indices of tasks: the same message where one triggers the next, or the
/// next waits for it and others; any stream of a callback that reads at its own pace.
pub(super) fn ways(stages: &[usize], streams: &Streams, callbacks: &[Callback]) -> Vec<Vec<usize>> {
    let Some((&start, rest)) = stages.split_first() else { return Vec::new() };
    let mut paths: Vec<Vec<usize>> = streams.outputs(start).map(|task| vec![task]).collect();
    for &stage in rest {
        let triggered = |from: usize| {
            streams.tasks(stage).filter(move |to| callbacks[*to].trigger.is_some_and(|(i, _)| i == from))
        };
        let direct =
            paths.iter().any(|path| path.last().is_some_and(|from| triggered(*from).next().is_some()));
        let extend = |path: &Vec<usize>| -> Vec<Vec<usize>> {
            let from = path.last().copied().unwrap_or(0);
            let next: Vec<usize> =
                if direct { triggered(from).collect() } else { streams.outputs(stage).collect() };
            // What takes a message for a join hands it on to that.
            let join = streams.outputs(stage).next().filter(|_| direct && streams.is_join(stage));
            next.into_iter().map(|to| path.iter().copied().chain([to]).chain(join).collect()).collect()
        };
        paths = paths.iter().flat_map(extend).take(1_000).collect();
    }
    paths
}
