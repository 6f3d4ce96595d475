// SPDX-License-Identifier: MIT OR Apache-2.0
//! Decides from both graphs which services are carried in which direction. The services thread executes the decision.

use crate::mirror::{Side, TopicKey, grouped};
use crate::rules::{Choice, Direction, Rules};
use std::collections::{BTreeMap, BTreeSet};
use tautline_transport::{Gid, NodeName, ServiceEndpoint, ServiceKind};

/// A service of the domain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OfferedService {
    /// The type hash that its server states.
    pub type_hash: Option<String>,
    /// The server's node.
    pub node: Option<NodeName>,
}

/// A service of the far side.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SoughtService {
    /// The type hash that clients in the domain state.
    pub type_hash: Option<String>,
    /// Its servers.
    pub servers: BTreeSet<ServerId>,
}

/// A server on the far side.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ServerId {
    /// Its node.
    pub node: Option<NodeName>,
    /// The GID of its request endpoint; zero if unknown: not every RMW announces it.
    pub gid: Gid,
}

impl ServerId {
    /// Whether both may be the same server.
    pub fn is(&self, other: &ServerId) -> bool {
        let is_unknown = [self.gid, other.gid].contains(&Gid::default());
        self.node == other.node && (is_unknown || self.gid == other.gid)
    }
}

/// Which services are carried, by direction.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Routes {
    /// Services of the domain, offered on the far side.
    pub offered: BTreeMap<TopicKey, OfferedService>,
    /// Services that only the far side has, with clients in the domain.
    pub sought: BTreeMap<TopicKey, SoughtService>,
    /// Services that cannot be mirrored, and why.
    pub problems: BTreeMap<String, String>,
}

impl Routes {
    /// Routes for the graphs `here` and `there`, both without this mirror's endpoints. Servers here that are not `announced` are
    /// left to another relay. A service offered `before` stays offered even if ROS gets a server of it: otherwise two bridges
    /// would defer to each other forever.
    pub fn of<'e>(
        side: Side,
        rules: &Rules,
        here: impl IntoIterator<Item = &'e ServiceEndpoint>,
        there: &[ServiceEndpoint],
        before: &Routes,
        announced: impl Fn(&ServiceEndpoint) -> bool,
    ) -> Self {
        let mut routes = Routes::default();
        for (name, ends) in grouped(here, |end| &*end.name) {
            match side {
                Side::Ros => routes.of_one_type(rules, name, &ends, there, before, &announced),
                Side::Network => routes.of_each_type(rules, name, &ends, there, &announced),
            }
        }
        routes
    }

    /// Each type of a service is separate, and several hosts may have servers of one name.
    fn of_each_type(
        &mut self,
        rules: &Rules,
        service: &str,
        here: &[&ServiceEndpoint],
        there: &[ServiceEndpoint],
        announced: &impl Fn(&ServiceEndpoint) -> bool,
    ) {
        let Some(choice) = rules.choice(service) else { return };
        for (of_type, ends) in grouped(here.iter().copied(), type_of) {
            let key = TopicKey::of(service, &choice, of_type.0, of_type.1);
            let servers: Vec<&&ServiceEndpoint> =
                ends.iter().filter(|end| end.kind == ServiceKind::Server).collect();
            let same = servers_of(there, &choice).filter(|end| type_of(end) == of_type);
            let same: Vec<&ServiceEndpoint> = same.collect();
            if choice.allows(Direction::Out) && servers.iter().any(|end| announced(end)) {
                let type_hash = key.type_hash.clone();
                self.offered.insert(key, OfferedService { type_hash, node: None });
            } else if choice.allows(Direction::In) && servers.is_empty() && !same.is_empty() {
                // All `ends` are clients.
                self.seek(key, ends[0], &same);
            }
        }
    }

    /// A service has one type and one server.
    fn of_one_type(
        &mut self,
        rules: &Rules,
        service: &str,
        here: &[&ServiceEndpoint],
        there: &[ServiceEndpoint],
        before: &Routes,
        announced: &impl Fn(&ServiceEndpoint) -> bool,
    ) {
        let Some(choice) = rules.choice(service) else { return };
        let servers = servers_of(there, &choice);
        let all = here.iter().filter(|end| end.kind == ServiceKind::Server);
        let is_offered = |end: &ServiceEndpoint| {
            let key = TopicKey::of(service, &choice, &end.type_name, None);
            before.offered.get(&key).is_some_and(|offered| offered.node == end.node)
        };
        let server = all.min_by_key(|end| (!announced(end), !end.origin.is_here(), !is_offered(end)));
        let is_asked = here.iter().any(|end| end.kind == ServiceKind::Client);
        // Of clients with different types, prefers the first that ROS can serve, at best with its definition.
        let rank = |end: &&&ServiceEndpoint| {
            let same = servers.clone().filter(|server| server.type_name == end.type_name);
            same.map(|server| end.type_hash.is_none() || end.type_hash == server.type_hash).max()
        };
        let Some(end) = server.or_else(|| here.iter().rev().max_by_key(rank)) else { return };
        if let Some(expected) = choice.type_name.as_ref().filter(|expected| **expected != end.type_name) {
            let reason = format!(
                "its type is {}, but the configuration says {expected}: correct or remove 'type'",
                end.type_name
            );
            return drop(self.problems.insert(service.to_owned(), reason));
        }
        let key = TopicKey::of(service, &choice, &end.type_name, None);
        let (same, other): (Vec<&ServiceEndpoint>, Vec<&ServiceEndpoint>) =
            servers.partition(|server| server.type_name == end.type_name);
        // Of servers with one name, a server in ROS is preferred over one of another host.
        let is_nearer = !same.is_empty() && server.is_some_and(|server| !server.origin.is_here());
        match (server, other.first()) {
            (Some(server), _) if !announced(server) => {}
            (Some(_), _) if is_nearer && is_asked && choice.allows(Direction::In) => {
                self.seek(key, end, &same);
            }
            (Some(_), _) if is_nearer => {}
            (Some(server), _) if choice.allows(Direction::Out) => {
                let is_alone = same.is_empty() && other.is_empty();
                if !is_alone {
                    // Clients in ROS would get two responses.
                    let reason = "both Tautline and ROS have a server of it: stop or rename one of them";
                    self.problems.insert(service.to_owned(), reason.to_owned());
                }
                if is_alone || before.offered.contains_key(&key) {
                    let (type_hash, node) = (server.type_hash.clone(), server.node.clone());
                    self.offered.insert(key, OfferedService { type_hash, node });
                }
            }
            (None, _) if choice.allows(Direction::In) && !same.is_empty() => {
                self.seek(key, end, &same);
            }
            (None, Some(other)) => {
                let reason = format!(
                    "clients here call it as {}, in ROS its type is {}: rename one of them, or use the same type",
                    end.type_name, other.type_name
                );
                self.problems.insert(service.to_owned(), reason);
            }
            _ => {}
        }
    }

    /// Adds a service of the far side, for clients in the domain like `end`.
    fn seek(&mut self, key: TopicKey, end: &ServiceEndpoint, servers: &[&ServiceEndpoint]) {
        let id = |server: &&ServiceEndpoint| ServerId { node: server.node.clone(), gid: server.gid };
        let servers = servers.iter().map(id).collect();
        self.sought.insert(key, SoughtService { type_hash: end.type_hash.clone(), servers });
    }
}

fn type_of(end: &ServiceEndpoint) -> (&str, Option<&str>) {
    (&end.type_name, end.type_hash.as_deref())
}

/// The far side's servers of `choice`.
fn servers_of<'e>(
    there: &'e [ServiceEndpoint],
    choice: &'e Choice,
) -> impl Iterator<Item = &'e ServiceEndpoint> + Clone {
    there.iter().filter(|end| end.kind == ServiceKind::Server && end.name == choice.far_topic)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rules::Rule;
    use tautline_transport::Origin;

    const SET_BOOL: &str = "std_srvs/srv/SetBool";

    fn end(kind: ServiceKind, name: &str, type_name: &str) -> ServiceEndpoint {
        ServiceEndpoint {
            kind,
            name: name.into(),
            type_name: type_name.into(),
            type_hash: None,
            gid: Gid::default(),
            node: Some(NodeName { namespace: "/".into(), name: "node".into() }),
            pid: None,
            is_remote: false,
            origin: Default::default(),
            teller: None,
        }
    }

    fn server(name: &str) -> ServiceEndpoint {
        end(ServiceKind::Server, name, SET_BOOL)
    }

    fn client(name: &str) -> ServiceEndpoint {
        end(ServiceKind::Client, name, SET_BOOL)
    }

    fn names<T>(keys: &BTreeMap<TopicKey, T>) -> Vec<(&str, &str)> {
        keys.keys().map(|key| (&*key.topic, &*key.far_topic)).collect()
    }

    fn of(rules: &Rules, here: &[ServiceEndpoint], there: &[ServiceEndpoint]) -> Routes {
        Routes::of(Side::Ros, rules, here, there, &Routes::default(), |_| true)
    }

    #[test]
    fn servers_here_are_offered_and_those_of_ros_only_to_clients_here() {
        let rules = Rules { auto: true, ..Rules::default() };
        let here = [server("/here"), client("/here"), client("/there"), client("/nowhere"), server("/both")];
        let again = ServiceEndpoint { gid: Gid([1; 16]), ..server("/there") };
        let there = [server("/there"), again, client("/here"), server("/unasked"), server("/both")];
        let routes = of(&rules, &here, &there);
        assert_eq!(names(&routes.offered), [("/here", "/here")]);
        assert_eq!(names(&routes.sought), [("/there", "/there")]);
        assert_eq!(routes.sought.values().next().unwrap().servers.len(), 2);
        assert!(routes.sought.keys().all(|key| key.topic != "/both"));
        assert!(routes.problems["/both"].contains("both Tautline and ROS"), "{:?}", routes.problems);
        assert_eq!(of(&Rules::default(), &here, &there), Routes::default());
    }

    /// Two servers of one name, in ROS and on another host: clients here use ROS's, and neither is announced to the other side.
    #[test]
    fn of_two_servers_of_one_name_none_is_nobodys() {
        let rules = Rules { auto: true, ..Rules::default() };
        let elsewhere = Origin { tag: 7, path: vec![1], ..Origin::default() };
        let far = ServiceEndpoint { origin: elsewhere, teller: Some(3), ..server("/both") };
        let routes = of(&rules, &[far.clone(), client("/both")], &[server("/both")]);
        assert_eq!((names(&routes.sought), routes.offered.len()), (vec![("/both", "/both")], 0));
        let unasked = of(&rules, std::slice::from_ref(&far), &[server("/both")]);
        assert_eq!(unasked, Routes::default());
        assert_eq!(names(&of(&rules, &[far], &[]).offered), [("/both", "/both")]);
    }

    #[test]
    fn types_and_directions() {
        let mut rule = Rule::new("/a".parse().unwrap());
        rule.far_topic = Some("/b".parse().unwrap());
        let rules = |rule: &Rule| Rules { rules: vec![rule.clone()], ..Rules::default() };
        let routes = of(&rules(&rule), &[client("/a")], &[server("/b")]);
        assert_eq!(names(&routes.sought), [("/a", "/b")]);
        let trigger = end(ServiceKind::Server, "/b", "std_srvs/srv/Trigger");
        let routes = of(&rules(&rule), &[client("/a")], std::slice::from_ref(&trigger));
        assert!(routes.sought.is_empty() && routes.problems["/a"].contains("std_srvs/srv/Trigger"));
        let asking = [client("/a"), end(ServiceKind::Client, "/a", "std_srvs/srv/Trigger")];
        let routes = of(&rules(&rule), &asking, std::slice::from_ref(&trigger));
        assert_eq!((names(&routes.sought), routes.problems.len()), (vec![("/a", "/b")], 0));
        rule.direction = Some(Direction::In);
        assert_eq!(of(&rules(&rule), &[server("/a")], &[]), Routes::default());
        rule.direction = Some(Direction::Out);
        assert_eq!(names(&of(&rules(&rule), &[server("/a")], &[]).offered), [("/a", "/b")]);
        rule.type_name = Some("std_srvs/srv/Empty".into());
        let routes = of(&rules(&rule), &[server("/a")], &[]);
        assert!(routes.offered.is_empty() && routes.problems["/a"].contains("std_srvs/srv/Empty"));
    }

    #[test]
    fn a_client_with_an_old_definition_denies_the_service_to_no_other() {
        let rules = Rules { auto: true, ..Rules::default() };
        let stated =
            |end: ServiceEndpoint, hash: &str| ServiceEndpoint { type_hash: Some(hash.to_owned()), ..end };
        let (old, new) = (stated(client("/a"), "old"), stated(client("/a"), "new"));
        for here in [[old.clone(), new.clone()], [new, old]] {
            let routes = of(&rules, &here, &[stated(server("/a"), "new")]);
            assert_eq!(routes.sought.values().next().unwrap().type_hash.as_deref(), Some("new"));
        }
    }

    #[test]
    fn of_two_servers_here_the_one_that_was_offered_stays_so() {
        let rules = Rules { auto: true, ..Rules::default() };
        let at = |name: &str| ServiceEndpoint {
            node: Some(NodeName { namespace: "/".into(), name: name.into() }),
            ..server("/a")
        };
        let first = of(&rules, &[at("one")], &[]);
        for here in [[at("one"), at("other")], [at("other"), at("one")]] {
            assert_eq!(Routes::of(Side::Ros, &rules, &here, &[], &first, |_| true), first);
        }
        assert_ne!(Routes::of(Side::Ros, &rules, &[at("other")], &[], &first, |_| true), first);
    }

    #[test]
    fn a_server_that_was_replaced_is_another_route() {
        let rules = Rules { auto: true, ..Rules::default() };
        let of = |gid| {
            let there = ServiceEndpoint { gid: Gid([gid; 16]), ..server("/a") };
            of(&rules, &[client("/a")], &[there])
        };
        assert_eq!(of(1), of(1));
        assert_ne!(of(1), of(2), "as many as before");
    }

    #[test]
    fn what_is_offered_stays_so() {
        let rules = Rules { auto: true, ..Rules::default() };
        let first = of(&rules, &[server("/a")], &[]);
        let second = Routes::of(Side::Ros, &rules, &[server("/a")], &[server("/a")], &first, |_| true);
        assert_eq!((names(&second.offered), second.problems.len()), (vec![("/a", "/a")], 1));
        assert!(Routes::of(Side::Ros, &rules, &[], &[server("/a")], &second, |_| true).offered.is_empty());
    }

    #[test]
    fn on_a_network_each_type_is_a_service_of_its_own() {
        let rules = Rules { auto: true, ..Rules::default() };
        let typed = |end: ServiceEndpoint, digit: &str| ServiceEndpoint {
            type_hash: Some(format!("RIHS01_{digit}")),
            ..end
        };
        let one = |end| typed(end, "1");
        let here = [
            one(server("/one")),
            one(client("/one")),
            one(client("/two")),
            typed(server("/three"), "2"),
            one(client("/three")),
            // Another relay also announces this domain's server.
            one(server("/four")),
            one(client("/four")),
            one(client("/nowhere")),
        ];
        let there = ["/one", "/two", "/three", "/four"].map(|name| one(server(name)));
        let announced = |end: &ServiceEndpoint| end.name != "/four";
        let routes = Routes::of(Side::Network, &rules, &here, &there, &Routes::default(), announced);
        assert_eq!(names(&routes.offered), [("/one", "/one"), ("/three", "/three")]);
        assert_eq!(names(&routes.sought), [("/three", "/three"), ("/two", "/two")]);
    }
}
