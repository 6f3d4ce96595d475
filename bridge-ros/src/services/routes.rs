// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which services go which way: decided here from what exists on both sides, done elsewhere.

use std::collections::{BTreeMap, BTreeSet};
use tautline_relay::{Direction, Rules};
use tautline_transport::{Gid, NodeName, ServiceEndpoint, ServiceKind};

/// A service on both sides.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct ServiceKey {
    /// Tautline's name of it.
    pub(crate) service: String,
    /// ROS's name of it.
    pub(crate) ros_service: String,
    /// Its type.
    pub(crate) type_name: String,
}

/// A service that Tautline has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct OfferedService {
    /// What its server says of its type.
    pub(crate) type_hash: Option<String>,
    /// The server's node.
    pub(crate) node: Option<NodeName>,
}

/// A service that ROS has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SoughtService {
    /// What Tautline's clients say of its type.
    pub(crate) type_hash: Option<String>,
    /// Its servers in ROS.
    pub(crate) servers: BTreeSet<ServerId>,
}

/// A server in ROS.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ServerId {
    pub(crate) node: Option<NodeName>,
    /// Where it takes requests; zero if that is not known (yet): not every RMW tells.
    pub(crate) gid: Gid,
}

impl ServerId {
    /// Whether both may be the same one.
    pub(crate) fn is(&self, other: &ServerId) -> bool {
        let is_unknown = [self.gid, other.gid].contains(&Gid::default());
        self.node == other.node && (is_unknown || self.gid == other.gid)
    }
}

/// Which services go which way.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Routes {
    /// Tautline's: ROS may ask.
    pub(crate) offered: BTreeMap<ServiceKey, OfferedService>,
    /// Those that only ROS has, with clients here.
    pub(crate) sought: BTreeMap<ServiceKey, SoughtService>,
    /// Services that cannot be bridged, and why.
    pub(crate) problems: BTreeMap<String, String>,
}

impl Routes {
    /// What follows from what exists: `here` in the domain, `there` in ROS, both without what this bridge made. A server here that
    /// is not `announced` is left to somebody else. What was offered `before` stays so though ROS gets a server of it: two would make
    /// way for each other for ever.
    pub(crate) fn of<'e>(
        rules: &Rules,
        here: impl IntoIterator<Item = &'e ServiceEndpoint>,
        there: &[ServiceEndpoint],
        before: &Routes,
        announced: impl Fn(&ServiceEndpoint) -> bool,
    ) -> Self {
        let mut routes = Routes::default();
        let mut services: BTreeMap<&str, Vec<&ServiceEndpoint>> = BTreeMap::new();
        for end in here {
            services.entry(&end.name).or_default().push(end);
        }
        for (name, ends) in services {
            routes.add(rules, name, &ends, there, before, &announced);
        }
        routes
    }

    fn add(
        &mut self,
        rules: &Rules,
        service: &str,
        here: &[&ServiceEndpoint],
        there: &[ServiceEndpoint],
        before: &Routes,
        announced: &impl Fn(&ServiceEndpoint) -> bool,
    ) {
        let Some(choice) = rules.choice(service) else { return };
        let servers =
            there.iter().filter(|end| end.kind == ServiceKind::Server && end.name == choice.far_topic);
        let all = here.iter().filter(|end| end.kind == ServiceKind::Server);
        let server = all.min_by_key(|end| (!announced(end), !end.origin.is_here()));
        let is_asked = here.iter().any(|end| end.kind == ServiceKind::Client);
        // Of clients that ask for different types, those go on that ROS can answer.
        let is_there =
            |end: &&&ServiceEndpoint| servers.clone().any(|server| server.type_name == end.type_name);
        let Some(end) = server.or_else(|| here.iter().find(is_there)).or_else(|| here.first()) else {
            return;
        };
        if let Some(expected) = choice.type_name.as_ref().filter(|expected| **expected != end.type_name) {
            let reason = format!(
                "it is a {}, but the configuration says {expected}: correct 'type', or leave it out",
                end.type_name
            );
            return drop(self.problems.insert(service.to_owned(), reason));
        }
        let key = ServiceKey {
            service: service.to_owned(),
            ros_service: choice.far_topic.clone(),
            type_name: end.type_name.clone(),
        };
        let (same, other): (Vec<&ServiceEndpoint>, Vec<&ServiceEndpoint>) =
            servers.partition(|server| server.type_name == end.type_name);
        // Of servers of one name ROS's own is nearer than one of another host.
        let is_nearer = !same.is_empty() && server.is_some_and(|server| !server.origin.is_here());
        match (server, other.first()) {
            (Some(server), _) if !announced(server) => {}
            (Some(_), _) if is_nearer && is_asked && choice.goes(Direction::In) => {
                self.seek(key, end, &same);
            }
            (Some(_), _) if is_nearer => {}
            (Some(server), _) if choice.goes(Direction::Out) => {
                let is_alone = same.is_empty() && other.is_empty();
                if !is_alone {
                    // Who asks in ROS would get two answers.
                    let reason = "both Tautline and ROS have a server of it: stop or rename one of them";
                    self.problems.insert(service.to_owned(), reason.to_owned());
                }
                if is_alone || before.offered.contains_key(&key) {
                    let (type_hash, node) = (server.type_hash.clone(), server.node.clone());
                    self.offered.insert(key, OfferedService { type_hash, node });
                }
            }
            (None, _) if choice.goes(Direction::In) && !same.is_empty() => {
                self.seek(key, end, &same);
            }
            (None, Some(other)) => {
                let reason = format!(
                    "clients here ask for a {}, in ROS it is a {}: rename one of them, or use the same type",
                    end.type_name, other.type_name
                );
                self.problems.insert(service.to_owned(), reason);
            }
            _ => {}
        }
    }

    /// For who asks as `end` does.
    fn seek(&mut self, key: ServiceKey, end: &ServiceEndpoint, servers: &[&ServiceEndpoint]) {
        let id = |server: &&ServiceEndpoint| ServerId { node: server.node.clone(), gid: server.gid };
        let servers = servers.iter().map(id).collect();
        self.sought.insert(key, SoughtService { type_hash: end.type_hash.clone(), servers });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_relay::Rule;
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

    fn names<T>(keys: &BTreeMap<ServiceKey, T>) -> Vec<(&str, &str)> {
        keys.keys().map(|key| (&*key.service, &*key.ros_service)).collect()
    }

    fn of(rules: &Rules, here: &[ServiceEndpoint], there: &[ServiceEndpoint]) -> Routes {
        Routes::of(rules, here, there, &Routes::default(), |_| true)
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
        assert!(routes.sought.keys().all(|key| key.service != "/both"));
        assert!(routes.problems["/both"].contains("both Tautline and ROS"), "{:?}", routes.problems);
        assert_eq!(of(&Rules::default(), &here, &there), Routes::default());
    }

    /// Two servers have one name, in ROS and on another host: clients here have ROS's, and neither goes on to the other.
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
        let second = Routes::of(&rules, &[server("/a")], &[server("/a")], &first, |_| true);
        assert_eq!((names(&second.offered), second.problems.len()), (vec![("/a", "/a")], 1));
        assert!(Routes::of(&rules, &[], &[server("/a")], &second, |_| true).offered.is_empty());
    }
}
