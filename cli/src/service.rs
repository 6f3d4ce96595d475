// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut service`: the services of a domain.

use crate::manners::{Manners, Outcome};
use clap::{Args, Subcommand};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};
use tautline::{GraphSnapshot, NodeName, ServiceKind};
use tautline_transport::graph_of;

/// Lists services.
///
/// Services of other hosts are seen if this host runs `taut gateway`.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut service list
  taut service list --json          with the nodes that answer")]
pub struct ServiceArgs {
    #[command(subcommand)]
    verb: Verb,
    #[command(flatten)]
    manners: Manners,
}

#[derive(Subcommand, Clone, Debug)]
enum Verb {
    /// Prints the services with their types, and how many servers and clients they have
    List,
}

/// Runs the verb.
pub fn run(args: &ServiceArgs) -> Outcome {
    let graph = graph_of(args.manners.domain()?)?;
    let services = services(&graph);
    let mut out = io::stdout().lock();
    let Verb::List = args.verb;
    if args.manners.json {
        writeln!(out, "{}", Value::from_iter(services.iter().map(Service::to_json)))?;
    } else {
        let head = ["service", "type", "where", "servers", "clients"];
        crate::table::write_table(&head, 3, services.iter().map(Service::row).collect(), &mut out)?;
    }
    Ok(())
}

struct Service<'g> {
    name: &'g str,
    type_name: &'g str,
    ends: Vec<&'g tautline::ServiceEndpoint>,
}

/// One for each name and type.
fn services(graph: &GraphSnapshot) -> Vec<Service<'_>> {
    let mut found: BTreeMap<(&str, &str), Vec<_>> = BTreeMap::new();
    for end in &graph.services {
        found.entry((&end.name, &end.type_name)).or_default().push(&**end);
    }
    found.into_iter().map(|((name, type_name), ends)| Service { name, type_name, ends }).collect()
}

impl Service<'_> {
    fn of(&self, kind: ServiceKind) -> impl Iterator<Item = &tautline::ServiceEndpoint> {
        self.ends.iter().copied().filter(move |end| end.kind == kind)
    }

    fn row(&self) -> (bool, Vec<String>) {
        let places = crate::table::places(self.ends.iter().map(|end| &end.origin));
        let counts = [ServiceKind::Server, ServiceKind::Client].map(|kind| self.of(kind).count().to_string());
        (true, [vec![self.name.into(), self.type_name.into(), places], counts.to_vec()].concat())
    }

    fn to_json(&self) -> Value {
        let nodes = |kind| {
            let end = |end: &tautline::ServiceEndpoint| {
                let node = end.node.as_ref().map(NodeName::full_name);
                json!({ "node": node, "remote": end.is_remote, "place": crate::table::place(&end.origin) })
            };
            self.of(kind).map(end).collect::<Value>()
        };
        json!({
            "service": self.name,
            "type": self.type_name,
            "hash": self.ends.iter().find_map(|end| end.type_hash.as_deref()),
            "servers": nodes(ServiceKind::Server),
            "clients": nodes(ServiceKind::Client),
        })
    }
}
