// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut node`: the nodes of a domain, and what each has.

use crate::arguments::full_name;
use crate::call::{action_of, node_named};
use crate::completions;
use crate::table::{place, whereabouts, write_table};
use crate::verb::{Outcome, Verbs};
use clap::Subcommand;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::sync::Arc;
use tautline_transport::{EndpointKind, GraphSnapshot, NodeInfo, ServiceKind, graph_of};

/// Lists nodes, and the topics, services and actions of a node.
///
/// Nodes of other hosts are visible if this host runs `taut gateway`.
#[derive(Subcommand, Clone, Debug)]
#[command(after_help = "Examples:
  taut node list
  taut node info /robot/camera
  taut node info camera --json")]
pub enum Verb {
    /// Prints the nodes, each with its process, or with its place if it is on another host
    List,
    /// Prints the topics, services and actions of a node
    Info {
        /// The node's name with its namespace [default namespace: /]
        #[arg(value_name = "NODE", add = completions::nodes())]
        node: String,
    },
}

pub fn run(args: &Verbs<Verb>) -> Outcome {
    let graph = graph_of(args.common.domain()?)?;
    for pair in graph.nodes.chunk_by(|one, other| one.name == other.name).filter(|same| same.len() > 1) {
        eprintln!("taut: {} nodes are called {}", pair.len(), pair[0].name);
    }
    let mut out = crate::print::stdout();
    match &args.verb {
        Verb::List if args.common.json => {
            writeln!(out, "{}", Value::from_iter(graph.nodes.iter().map(|node| facts(node))))?;
        }
        Verb::List => list(&graph.nodes, &mut out)?,
        Verb::Info { node } => {
            let node = node_named(&graph, &full_name(node))?;
            let parts = Parts::of(&graph, node);
            match args.common.json {
                true => writeln!(out, "{}", parts.to_json(node))?,
                false => parts.print(node, &mut out)?,
            }
        }
    }
    Ok(())
}

fn list(nodes: &[Arc<NodeInfo>], out: &mut impl Write) -> io::Result<()> {
    let row = |node: &Arc<NodeInfo>| {
        let process = node.pid.map_or_else(|| whereabouts(node), |pid| pid.to_string());
        (true, vec![node.name.full_name(), process])
    };
    write_table(&["node", "process"], 2, nodes.iter().map(row).collect(), out)
}

fn facts(node: &NodeInfo) -> Value {
    json!({
        "name": node.name.name,
        "namespace": node.name.namespace,
        "enclave": node.enclave,
        "pid": node.pid,
        "remote": node.is_remote,
        "place": place(&node.origin),
    })
}

/// Names and types of a node's endpoints by kind, in the order of output.
struct Parts(Vec<(&'static str, BTreeMap<String, String>)>);

impl Parts {
    fn of(graph: &GraphSnapshot, node: &NodeInfo) -> Self {
        let topics = |kind| {
            let ends = graph.endpoints.iter().filter(move |end| end.kind == kind);
            let own = ends.filter(|end| end.node.as_ref() == Some(&node.name) && !is_of_action(&end.topic));
            own.map(|end| (end.topic.clone(), end.topic_type.name.to_string())).collect()
        };
        let all = |kind| {
            graph.services.iter().filter(move |end| end.kind == kind && end.node.as_ref() == Some(&node.name))
        };
        let services = |kind| {
            let own = all(kind).filter(|end| !is_of_action(&end.name));
            own.map(|end| (end.name.clone(), end.type_name.clone())).collect()
        };
        let actions = |kind| {
            let actions = all(kind).filter_map(|end| action_of(&end.name, &end.type_name));
            actions.map(|(name, type_name)| (name.to_owned(), type_name.to_owned())).collect()
        };
        Parts(vec![
            ("subscribers", topics(EndpointKind::Subscription)),
            ("publishers", topics(EndpointKind::Publisher)),
            ("service_servers", services(ServiceKind::Server)),
            ("service_clients", services(ServiceKind::Client)),
            ("action_servers", actions(ServiceKind::Server)),
            ("action_clients", actions(ServiceKind::Client)),
        ])
    }

    fn to_json(&self, node: &NodeInfo) -> Value {
        let mut object = facts(node);
        for (part, entries) in &self.0 {
            object[part] =
                entries.iter().map(|(name, of_type)| json!({ "name": name, "type": of_type })).collect();
        }
        object
    }

    fn print(&self, node: &NodeInfo, out: &mut impl Write) -> io::Result<()> {
        let place = whereabouts(node);
        let enclave = if node.enclave == "/" { String::new() } else { format!(", enclave {}", node.enclave) };
        writeln!(out, "{} ({place}{enclave})", node.name)?;
        for (part, entries) in &self.0 {
            writeln!(out, "  {}:", part.replace('_', " "))?;
            entries.iter().try_for_each(|(name, of_type)| writeln!(out, "    {name}: {of_type}"))?;
        }
        Ok(())
    }
}

fn is_of_action(name: &str) -> bool {
    name.contains("/_action/")
}
