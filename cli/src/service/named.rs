// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services, and the actions that consist of them, by name and type.

use crate::call::action_of;
use crate::verb::{Failure, Outcome};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use tautline_transport::{GraphSnapshot, NodeName, ServiceEndpoint, ServiceKind};

/// A service or an action of one type, with its endpoints.
pub struct Named<'g> {
    pub name: &'g str,
    pub type_name: &'g str,
    ends: Vec<&'g ServiceEndpoint>,
}

/// The services of a domain.
pub fn services(graph: &GraphSnapshot) -> Vec<Named<'_>> {
    named(graph, |end| Some((&end.name, &end.type_name)))
}

/// The actions of a domain.
pub fn actions(graph: &GraphSnapshot) -> Vec<Named<'_>> {
    named(graph, |end| action_of(&end.name, &end.type_name))
}

/// Groups endpoints by name and type.
fn named<'g>(
    graph: &'g GraphSnapshot,
    name_and_type: impl Fn(&'g ServiceEndpoint) -> Option<(&'g str, &'g str)>,
) -> Vec<Named<'g>> {
    let mut found: BTreeMap<(&str, &str), Vec<_>> = BTreeMap::new();
    for end in &graph.services {
        if let Some(key) = name_and_type(end) {
            found.entry(key).or_default().push(&**end);
        }
    }
    found.into_iter().map(|((name, type_name), ends)| Named { name, type_name, ends }).collect()
}

/// The type to call with: that of the servers. If the user named a type, it must be a type of a server.
pub fn type_to_call(kind: &str, name: &str, all: &[Named], said: Option<String>) -> Outcome<String> {
    let served = all.iter().filter(|one| one.count(ServiceKind::Server) > 0);
    let types: Vec<&str> = served.clone().filter(|one| one.name == name).map(|one| one.type_name).collect();
    match (types.as_slice(), said) {
        ([], _) if all.iter().any(|one| one.name == name) => {
            Err(Failure::no(format!("{kind} '{name}' has clients, but no server that could answer")))
        }
        ([], _) => Err(Failure::unknown(kind, name, served.map(|one| one.name), &format!("{kind} list"))),
        (types, Some(said)) if !types.contains(&&*said) => {
            Err(Failure::unusable(format!("{kind} '{name}' is of type {}, not {said}", types.join(" or "))))
        }
        (_, Some(said)) => Ok(said),
        ([one], None) => Ok((*one).to_owned()),
        (types, None) => {
            let types = types.join(" and ");
            Err(Failure::unusable(format!("{kind} '{name}' has servers of types {types}: say which")))
        }
    }
}

impl Named<'_> {
    fn of(&self, kind: ServiceKind) -> impl Iterator<Item = &ServiceEndpoint> {
        self.ends.iter().copied().filter(move |end| end.kind == kind)
    }

    pub fn count(&self, kind: ServiceKind) -> usize {
        self.of(kind).count()
    }

    /// The nodes with such an endpoint.
    pub fn nodes(&self, kind: ServiceKind) -> impl Iterator<Item = String> {
        self.of(kind)
            .map(|end| end.node.as_ref().map_or("a process without nodes".into(), NodeName::full_name))
    }

    pub fn row(&self) -> (bool, Vec<String>) {
        let places = crate::table::places(self.ends.iter().map(|end| &end.origin));
        let counts = [ServiceKind::Server, ServiceKind::Client].map(|kind| self.count(kind).to_string());
        (true, [vec![self.name.into(), self.type_name.into(), places], counts.to_vec()].concat())
    }

    /// `kind` is `service` or `action`.
    pub fn to_json(&self, kind: &str) -> Value {
        let nodes = |kind| {
            let end = |end: &ServiceEndpoint| {
                let node = end.node.as_ref().map(NodeName::full_name);
                json!({ "node": node, "remote": end.is_remote, "place": crate::table::place(&end.origin) })
            };
            self.of(kind).map(end).collect::<Value>()
        };
        let mut object = json!({
            kind: self.name,
            "type": self.type_name,
            "servers": nodes(ServiceKind::Server),
            "clients": nodes(ServiceKind::Client),
        });
        // The hash of an action would be that of one of its services.
        if kind == "service" {
            object["hash"] = json!(self.ends.iter().find_map(|end| end.type_hash.as_deref()));
        }
        object
    }
}
