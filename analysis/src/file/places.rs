// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which host and core each callback is on.
use super::declared::{Callback, Declared, Node};
use super::problem::Collector;
use super::reader::At;

/// Where a callback runs: the indices of its node, host and core (among all cores of all hosts).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    pub node: usize,
    pub host: usize,
    pub core: usize,
}

/// All cores, as (host, number), and the place of each callback that has one.
pub(super) fn resolve(file: &Declared, problems: &Collector) -> (Vec<(usize, usize)>, Vec<Option<Place>>) {
    let hosts = file.hosts.iter().enumerate();
    let cores: Vec<_> = hosts.flat_map(|(h, host)| host.cores.iter().map(move |core| (h, *core))).collect();
    for (what, missing, example) in [
        ("host", file.hosts.is_empty(), "[hosts.robot]"),
        ("node", file.nodes.is_empty(), "[nodes.driver]"),
        ("callback", file.callbacks.is_empty(), "[callbacks.scan]"),
    ] {
        if missing {
            problems.at(0).add(format!("the file has no {what}: add one, such as {example}"));
        }
    }
    let node_hosts: Vec<_> = file.nodes.iter().map(|node| host_of(file, node, problems)).collect();
    for (node, host) in file.nodes.iter().zip(&node_hosts) {
        if let (Some(core), Some(host)) = (&node.core, host) {
            core_index(file, &cores, *host, core, &format!("node `{}`", node.name), problems);
        }
    }
    let mut place = |callback: &Callback| {
        let node = node_of(file, callback, problems)?;
        let host = node_hosts[node]?;
        let title = format!("callback `{}`", callback.name);
        let core = match (&callback.core, &file.nodes[node].core) {
            (Some(core), _) => core_index(file, &cores, host, core, &title, problems)?,
            // A wrong core is reported where the node names it.
            (None, Some(core)) => {
                cores.iter().position(|(h, c)| *h == host && i64::try_from(*c) == Ok(core.value))?
            }
            (None, None) => {
                let mut only = (0..cores.len()).filter(|i| cores[*i].0 == host);
                match (only.next(), only.next()) {
                    (Some(core), None) => core,
                    // The core to which its messages are charged; the callback may run on any.
                    (Some(core), _) if callback.floats.is_some() => core,
                    (None, _) => return None,
                    _ => {
                        let message =
                            "has no core: add `core` to it or to its node, since its host has several";
                        problems.at(callback.at).add(format!("{title} {message}"));
                        return None;
                    }
                }
            }
        };
        Some(Place { node, host, core })
    };
    let places = file.callbacks.iter().map(&mut place).collect();
    (cores, places)
}

fn host_of(file: &Declared, node: &Node, problems: &Collector) -> Option<usize> {
    match &node.host {
        Some(name) => {
            let found = file.hosts.iter().position(|host| host.name == name.value);
            if found.is_none() {
                let hint = problems.suggestion(&name.value, file.hosts.iter().map(|host| host.name.as_str()));
                problems.at(name.at).add(format!(
                    "node `{}` is on host `{}`, which is not in [hosts]{hint}",
                    node.name, name.value
                ));
            }
            found
        }
        None if file.hosts.len() > 1 => {
            problems
                .at(node.at)
                .add(format!("node `{}` lacks `host`: add it, since there are several", node.name));
            None
        }
        None => (!file.hosts.is_empty()).then_some(0),
    }
}

fn node_of(file: &Declared, callback: &Callback, problems: &Collector) -> Option<usize> {
    match &callback.node {
        Some(name) => {
            let found = file.nodes.iter().position(|node| node.name == name.value);
            if found.is_none() {
                let hint = problems.suggestion(&name.value, file.nodes.iter().map(|node| node.name.as_str()));
                let (callback, node) = (&callback.name, &name.value);
                problems.at(name.at).add(format!(
                    "callback `{callback}` belongs to node `{node}`, which is not in [nodes]{hint}"
                ));
            }
            found
        }
        None if file.nodes.len() > 1 => {
            problems
                .at(callback.at)
                .add(format!("callback `{}` lacks `node`: add it, since there are several", callback.name));
            None
        }
        None => (!file.nodes.is_empty()).then_some(0),
    }
}

fn core_index(
    file: &Declared,
    cores: &[(usize, usize)],
    host: usize,
    core: &At<i64>,
    title: &str,
    problems: &Collector,
) -> Option<usize> {
    let found = cores.iter().position(|(h, number)| *h == host && i64::try_from(*number) == Ok(core.value));
    if found.is_none() {
        let host = &file.hosts[host];
        let list = host.cores.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        problems.at(core.at).add(format!(
            "{title} is on core {}, which host `{}` does not have: use one of {list}",
            core.value, host.name
        ));
    }
    found
}
