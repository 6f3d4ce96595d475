// SPDX-License-Identifier: MIT OR Apache-2.0
//! Exchanges types with other hosts through ROS 2's service `~/get_type_description`: requests unknown types from the nodes on
//! other hosts that publish them, and serves the type descriptions of nodes on this host from the [`SchemaStore`].
//!
//! Responses are untrusted: bounded before they are stored, and stored only if their computed hash is the requested one.

use crate::events::{Events, NetworkEvent};
use crate::graph::Graph;
use crate::tokens::LocalEndpoint;
use crate::types::Types;
use crate::wire::{
    Attachment, ENCAPSULATION, Endpoint, EndpointKind, NodeName, Token, TopicKey, TypeId, WireQos,
    check_encapsulation, endpoint_gid,
};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline_relay::Event;
use tautline_rt::clock::wall_ns;
use tautline_schema::{DynamicMessage, Packages, Schema, SchemaError, TypeDescription, TypeName};
use tautline_transport::{Gid, MAX_SCHEMA_BYTES, Origin, SchemaStore, ServiceEndpoint, ServiceKind};
use zenoh::bytes::ZBytes;
use zenoh::query::{ConsolidationMode, Query, QueryTarget, Queryable, Reply};
use zenoh::sample::Locality;
use zenoh::{Session, Wait};

const SERVICE: &str = "type_description_interfaces/srv/GetTypeDescription";
const SUFFIX: &str = "/get_type_description";
/// Time-out of a request.
const TIMEOUT: Duration = Duration::from_secs(3);
const MAX_PENDING: usize = 64;
/// Maximum of remembered requests that were not successful.
const MAX_ASKED: usize = 4096;
/// Longest request to parse: names and a hash.
const MAX_REQUEST_BYTES: usize = 4096;

macro_rules! definitions {
    ($($name:literal),*) => {
        [$((
            concat!("type_description_interfaces/", $name),
            include_str!(concat!("../definitions/", $name)),
        )),*]
    };
}

/// The definitions of the service's package.
const DEFINITIONS: [(&str, &str); 7] = definitions!(
    "msg/Field.msg",
    "msg/FieldType.msg",
    "msg/IndividualTypeDescription.msg",
    "msg/KeyValue.msg",
    "msg/TypeDescription.msg",
    "msg/TypeSource.msg",
    "srv/GetTypeDescription.srv"
);

/// Why a response or request was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub(crate) enum Refused {
    #[error("a description that is too long")]
    Length,
    #[error("a malformed reply")]
    Malformed,
    #[error("a node does not know its own type")]
    Unsuccessful,
    #[error("an invalid type description")]
    Invalid,
    #[error("a description of another type than asked for")]
    Hash,
    #[error("a definition that could not be kept")]
    Store,
    #[error("no reply")]
    Silence,
    #[error("a malformed request")]
    Request,
    #[error("asked for a type that is not known here")]
    Unknown,
}

/// The client and server of the service.
pub(crate) struct Descriptions {
    id: TypeId,
    request: Arc<Schema>,
    response: Arc<Schema>,
    store: SchemaStore,
    events: Events,
    /// Pending requests, and when each was sent.
    pending: HashMap<TypeId, Instant>,
    /// Requests sent so far, by type and service.
    asked: HashSet<(TypeId, String)>,
    answering: BTreeMap<String, Queryable<()>>,
    pub(crate) counts: BTreeMap<String, u64>,
}

impl Descriptions {
    pub(crate) fn new(store: SchemaStore, events: Events) -> Result<Self, SchemaError> {
        let mut packages = Packages::new();
        for (file, text) in DEFINITIONS {
            let name = file.rsplit_once('.').map_or(file, |(name, _)| name);
            packages.add_text(&name.parse()?, file, text)?;
        }
        let mut schema = |name: String| -> Result<Arc<Schema>, SchemaError> {
            Ok(Arc::new(packages.schema(&name.parse::<TypeName>()?)?))
        };
        let service = schema(SERVICE.into())?;
        Ok(Descriptions {
            id: TypeId { name: service.name().clone(), hash: service.hash() },
            request: schema(format!("{SERVICE}_Request"))?,
            response: schema(format!("{SERVICE}_Response"))?,
            store,
            events,
            pending: HashMap::new(),
            asked: HashSet::new(),
            answering: BTreeMap::new(),
            counts: BTreeMap::new(),
        })
    }

    fn count(&mut self, what: impl ToString) {
        *self.counts.entry(what.to_string()).or_default() += 1;
    }

    /// Requests the topic's type from a node of one of its remote publishers, unless a request is pending or all were requested before.
    pub(crate) fn request(&mut self, session: &Session, key: &TopicKey, graph: &Graph) {
        let id = &key.type_id;
        if !self.may_request(id) {
            return;
        }
        let wanted: HashSet<String> = graph.publishing_nodes(key).map(service_of).collect();
        let served = graph.tokens().filter_map(|token| token.endpoint.as_ref()).filter(|end| {
            end.kind == EndpointKind::Service && end.type_id == self.id && wanted.contains(&end.name)
        });
        let mut next = served
            .map(|end| end.name.clone())
            .filter(|name| !self.asked.contains(&(id.clone(), name.clone())));
        let Some(service) = next.next() else { return };
        drop(next);
        if self.asked.len() >= MAX_ASKED {
            self.asked.clear();
        }
        self.asked.insert((id.clone(), service.clone()));
        if let Err(error) = self.get(session, key.domain, service, id) {
            return tracing::warn!("the type of topic '{}' cannot be requested: {error}", key.topic);
        }
        self.pending.insert(id.clone(), Instant::now());
    }

    /// Whether no request for the type is pending, and there is room for one. Ends all requests that got no reply in time, also those for
    /// types that are no longer needed.
    fn may_request(&mut self, id: &TypeId) -> bool {
        let before = self.pending.len();
        self.pending.retain(|_, since| since.elapsed() < TIMEOUT);
        (self.pending.len()..before).for_each(|_| self.count(Refused::Silence));
        !self.pending.contains_key(id) && self.pending.len() < MAX_PENDING
    }

    /// Forgets the requests for a type that is no longer needed, so that a later request may go to any node again.
    pub(crate) fn forget(&mut self, id: &TypeId) {
        self.asked.retain(|(asked, _)| asked != id);
    }

    fn get(&mut self, session: &Session, domain: u32, service: String, id: &TypeId) -> zenoh::Result<()> {
        let request = serde_json::json!({
            "type_name": id.name.to_string(),
            "type_hash": id.hash.to_string(),
            "include_type_sources": false,
        });
        let request = DynamicMessage::from_json_value(&self.request, &request)?.to_cdr();
        let attachment =
            Attachment { sequence_number: 1, source_timestamp_ns: wall_ns(), gid: Gid::default() };
        let (events, asked) = (self.events.clone(), id.clone());
        let answer = move |reply: Reply| {
            let Ok(sample) = reply.result() else { return };
            let payload = sample.payload();
            // Oversized responses are refused without being copied.
            let bytes = (payload.len() <= MAX_SCHEMA_BYTES).then(|| payload.to_bytes().into_owned());
            let _ = events.try_send(Event::FarChange(NetworkEvent::Described(asked.clone(), bytes)));
        };
        let key = TopicKey { domain, topic: service, type_id: self.id.clone() };
        (session.get(key.to_string()).payload(request).attachment(attachment.encode().as_slice()))
            .target(QueryTarget::AllComplete)
            .consolidation(ConsolidationMode::None)
            .allowed_destination(Locality::Remote)
            .timeout(TIMEOUT)
            .callback(answer)
            .wait()
    }

    /// Handles a response, and stores a valid one.
    pub(crate) fn learn(&mut self, id: &TypeId, payload: Option<&[u8]>) {
        // Only the first response to a request is handled.
        if self.pending.remove(id).is_none() {
            return;
        }
        let outcome = self.check(id, payload).and_then(|schema| {
            self.store.keep(&id.hash.to_string(), &schema.to_text()).map_err(|_| Refused::Store)
        });
        match outcome {
            Ok(()) => self.count("learned"),
            Err(reason) => self.count(reason),
        }
    }

    fn check(&self, id: &TypeId, payload: Option<&[u8]>) -> Result<Schema, Refused> {
        let payload = payload.filter(|bytes| bytes.len() <= MAX_SCHEMA_BYTES).ok_or(Refused::Length)?;
        check_encapsulation(payload).map_err(|_| Refused::Malformed)?;
        let response = DynamicMessage::from_cdr(&self.response, payload).map_err(|_| Refused::Malformed)?;
        let mut response = response.to_json_value();
        if response["successful"] != true {
            return Err(Refused::Unsuccessful);
        }
        let description: TypeDescription =
            serde_json::from_value(response["type_description"].take()).map_err(|_| Refused::Invalid)?;
        let schema = Schema::from_description(&description).map_err(|_| Refused::Invalid)?;
        if *schema.name() != id.name || schema.hash() != id.hash {
            return Err(Refused::Hash);
        }
        Ok(schema)
    }

    /// The service to announce for each local node that has no type description server of its own.
    pub(crate) fn offered<'n>(
        &self,
        nodes: impl Iterator<Item = &'n NodeName>,
        endpoints: &[LocalEndpoint],
    ) -> Vec<LocalEndpoint> {
        let nodes: BTreeSet<&NodeName> = nodes.collect();
        let is_own =
            |name: &str| endpoints.iter().any(|end| end.kind == EndpointKind::Service && end.topic == name);
        let offer = |node: &NodeName| {
            let topic = service_of(node);
            let (kind, qos) = (EndpointKind::Service, WireQos { depth: 10, ..WireQos::default() });
            let (node, type_id) = (node.clone(), self.id.clone());
            // A unique GID: the hash of the endpoint's token.
            let (name, suffix) = (topic.clone(), String::new());
            let said = Endpoint { id: 0, kind, name, type_id: type_id.clone(), qos, suffix };
            let (endpoint, note) = (Some(said), String::new());
            let said = Token { domain: 0, zid: 0, node_id: 0, node: node.clone(), endpoint, note };
            let gid = endpoint_gid(&said);
            LocalEndpoint { gid, kind, topic, type_id, qos, node, origin: Origin::here(gid, "") }
        };
        nodes.into_iter().map(offer).filter(|end| !is_own(&end.topic)).collect()
    }

    /// Whether `end`, a server of the domain, is its node's own type description server.
    pub(crate) fn answers_for(&self, end: &ServiceEndpoint) -> bool {
        let is_of_node = |node: &tautline_transport::NodeName| {
            end.name.strip_suffix(SUFFIX).is_some_and(|name| name == node.full_name())
        };
        end.kind == ServiceKind::Server
            && end.type_name == self.id.name.as_str()
            && end.node.as_ref().is_some_and(is_of_node)
    }

    /// Whether `end` is its node's own type description server.
    pub(crate) fn is_theirs(&self, end: &LocalEndpoint) -> bool {
        end.kind == EndpointKind::Service && end.type_id == self.id && end.topic == service_of(&end.node)
    }

    /// Serves exactly these services.
    pub(crate) fn answer_at(&mut self, session: &Session, domain: u32, services: BTreeSet<String>) {
        self.answering.retain(|name, _| services.contains(name));
        for name in services {
            if self.answering.contains_key(&name) {
                continue;
            }
            let events = self.events.clone();
            let key = TopicKey { domain, topic: name.clone(), type_id: self.id.clone() };
            let declared = (session.declare_queryable(key.to_string()).complete(true))
                .allowed_origin(Locality::Remote)
                // If the queue is full, the query is dropped, and its client retries.
                .callback(move |query| drop(events.try_send(Event::FarChange(NetworkEvent::Asked(query)))))
                .wait();
            match declared {
                Ok(queryable) => drop(self.answering.insert(name, queryable)),
                Err(error) => tracing::warn!("service {name} is not served: {error}"),
            }
        }
    }

    pub(crate) fn answer(&mut self, query: &Query, types: &mut Types) {
        match self.reply(query.payload(), types) {
            Err(reason) => self.count(reason),
            Ok((reply, outcome)) => {
                self.count(outcome);
                let asked = query.attachment().and_then(|bytes| Attachment::parse(&bytes.to_bytes()).ok());
                let echoed = Attachment { source_timestamp_ns: wall_ns(), ..asked.unwrap_or_default() };
                let sent =
                    query.reply(query.key_expr().clone(), reply).attachment(echoed.encode().as_slice());
                if let Err(error) = sent.wait() {
                    tracing::debug!("a type description is not sent: {error}");
                }
            }
        }
    }

    fn reply(&self, payload: Option<&ZBytes>, types: &mut Types) -> Result<(Vec<u8>, String), Refused> {
        let payload = payload.filter(|bytes| bytes.len() <= MAX_REQUEST_BYTES).ok_or(Refused::Request)?;
        let request = payload.to_bytes();
        if !request.starts_with(&ENCAPSULATION[..2]) {
            return Err(Refused::Request);
        }
        let request = DynamicMessage::from_cdr(&self.request, &request).map_err(|_| Refused::Request)?;
        let request = request.to_json_value();
        let text = |field: &str| request[field].as_str().unwrap_or_default();
        let id = text("type_name").parse().ok().zip(text("type_hash").parse().ok());
        let schema = id.and_then(|(name, hash)| types.schema(&TypeId { name, hash }));
        let (response, outcome) = match schema {
            Some(schema) => {
                let description = serde_json::to_value(TypeDescription::from(&*schema));
                let description = description.map_err(|_| Refused::Unknown)?;
                let response = serde_json::json!({ "successful": true, "type_description": description });
                (response, "answered".to_owned())
            }
            None => {
                let reason = format!("{} is not known on this host", text("type_name"));
                let response = serde_json::json!({ "successful": false, "failure_reason": reason });
                (response, Refused::Unknown.to_string())
            }
        };
        let response =
            DynamicMessage::from_json_value(&self.response, &response).map_err(|_| Refused::Request)?;
        Ok((response.to_cdr(), outcome))
    }
}

fn service_of(node: &NodeName) -> String {
    format!("{}{SUFFIX}", node.full_name())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use std::sync::mpsc;

    fn descriptions(store: &std::path::Path) -> Descriptions {
        Descriptions::new(SchemaStore::at(store), mpsc::sync_channel(1).0).unwrap()
    }

    fn types(store: &std::path::Path) -> Types {
        Types::new(SchemaStore::at(store), Packages::new())
    }

    fn pose() -> Schema {
        let text = "Part[<=3] parts\nstring name \"none\"\n\
            ================================================================================\n\
            MSG: demo_msgs/Part\nfloat64[2] at\nuint8 kind\n";
        Schema::from_text(&"demo_msgs/msg/Pose".parse().unwrap(), text).unwrap()
    }

    fn id(schema: &Schema) -> TypeId {
        TypeId { name: schema.name().clone(), hash: schema.hash() }
    }

    fn question(asker: &Descriptions, id: &TypeId) -> ZBytes {
        let request =
            serde_json::json!({ "type_name": id.name.to_string(), "type_hash": id.hash.to_string() });
        DynamicMessage::from_json_value(&asker.request, &request).unwrap().to_cdr().into()
    }

    #[test]
    fn the_service_is_ros_2s() {
        let store = tempfile::tempdir().unwrap();
        let service = descriptions(store.path()).id;
        assert_eq!(service.name.as_str(), SERVICE);
        let hash = "RIHS01_69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5";
        assert_eq!(service.hash.to_string(), hash);
    }

    #[test]
    fn what_one_host_knows_another_learns() {
        let (here, there) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let pose = pose();
        let id = id(&pose);
        SchemaStore::at(there.path()).keep(&id.hash.to_string(), &pose.to_text()).unwrap();
        let (mut asker, answerer) = (descriptions(here.path()), descriptions(there.path()));
        let question = question(&asker, &id);
        let (reply, outcome) = answerer.reply(Some(&question), &mut types(there.path())).unwrap();
        assert_eq!(outcome, "answered");

        asker.learn(&id, Some(&reply));
        assert!(asker.counts.is_empty(), "no request");
        asker.pending.insert(id.clone(), Instant::now());
        asker.learn(&id, Some(&reply));
        asker.learn(&id, Some(&reply));
        assert_eq!(asker.counts, BTreeMap::from([("learned".into(), 1)]));
        let learned = types(here.path()).schema(&id).unwrap();
        assert_eq!((learned.hash(), learned.referenced().count()), (pose.hash(), 1));

        // The other host does not know it, and says so.
        let (reply, _) =
            asker.reply(Some(&question), &mut types(tempfile::tempdir().unwrap().path())).unwrap();
        assert_eq!(asker.check(&id, Some(&reply)).unwrap_err(), Refused::Unsuccessful);
    }

    #[test]
    fn what_is_not_what_was_asked_for_is_refused() {
        let store = tempfile::tempdir().unwrap();
        let descriptions = descriptions(store.path());
        let (pose, mut types) = (pose(), types(store.path()));
        SchemaStore::at(store.path()).keep(&pose.hash().to_string(), &pose.to_text()).unwrap();
        let id = id(&pose);
        let (reply, _) = descriptions.reply(Some(&question(&descriptions, &id)), &mut types).unwrap();
        assert!(descriptions.check(&id, Some(&reply)).is_ok());
        let other = TypeId {
            hash: id
                .hash
                .to_string()
                .replace("RIHS01_", "")
                .chars()
                .rev()
                .fold("RIHS01_".to_owned(), |text, digit| text + &digit.to_string())
                .parse()
                .unwrap(),
            ..id.clone()
        };
        let renamed = TypeId { name: "demo_msgs/msg/Other".parse().unwrap(), ..id.clone() };
        for (id, payload, reason) in [
            (&other, Some(&*reply), Refused::Hash),
            (&renamed, Some(&*reply), Refused::Hash),
            (&id, None, Refused::Length),
            (&id, Some(&[][..]), Refused::Malformed),
            (&id, Some(&[0, 1, 0, 0]), Refused::Malformed),
            (&id, Some(&[0, 0, 0, 0, 1]), Refused::Malformed),
            (&id, Some(&reply[..reply.len() / 2]), Refused::Malformed),
            (&id, Some(&vec![0; MAX_SCHEMA_BYTES + 1]), Refused::Length),
        ] {
            assert_eq!(descriptions.check(id, payload).unwrap_err(), reason);
        }
        for request in
            [None, Some(ZBytes::from(vec![0; MAX_REQUEST_BYTES + 1])), Some(ZBytes::from(b"x".to_vec()))]
        {
            assert_eq!(descriptions.reply(request.as_ref(), &mut types).unwrap_err(), Refused::Request);
        }
        // Any bytes: the requested type, or refused.
        let mut random = tautline_seed::random();
        for _ in 0..5000 {
            let mut reply = reply.clone();
            for _ in 0..random.random_range(1..4) {
                let at = random.random_range(0..reply.len());
                reply[at] = random.random();
            }
            if let Ok(schema) = descriptions.check(&id, Some(&reply)) {
                assert_eq!(schema.hash(), id.hash);
            }
        }
    }

    /// The topics of the types may have ended in the meantime.
    #[test]
    fn requests_without_a_reply_keep_no_place() {
        let store = tempfile::tempdir().unwrap();
        let mut descriptions = descriptions(store.path());
        let of = |n: usize| TypeId { name: format!("demo_msgs/msg/T{n}").parse().unwrap(), ..id(&pose()) };
        const LATER: Duration = Duration::from_secs(3600);
        let later = Instant::now() + LATER;
        descriptions.pending = (0..MAX_PENDING).map(|n| (of(n), later)).collect();
        assert!(!descriptions.may_request(&of(MAX_PENDING)), "no room");
        descriptions.pending.values_mut().skip(1).for_each(|since| *since -= LATER + TIMEOUT);
        assert!(descriptions.may_request(&of(MAX_PENDING)));
        let pending = descriptions.pending.keys().next().unwrap().clone();
        assert!(!descriptions.may_request(&pending));
        assert_eq!(descriptions.counts, BTreeMap::from([("no reply".into(), MAX_PENDING as u64 - 1)]));
    }

    #[test]
    fn nodes_that_answer_themselves_are_let() {
        let store = tempfile::tempdir().unwrap();
        let descriptions = descriptions(store.path());
        let nodes = [NodeName::new("/", "a"), NodeName::new("/robot", "b")];
        let names =
            |offered: &[LocalEndpoint]| offered.iter().map(|end| end.topic.clone()).collect::<Vec<_>>();
        let offered = descriptions.offered(nodes.iter(), &[]);
        assert_eq!(names(&offered), ["/a/get_type_description", "/robot/b/get_type_description"]);
        assert_ne!(offered[0].gid, offered[1].gid);
        let own = LocalEndpoint { gid: Gid([1; 16]), ..offered[0].clone() };
        assert_eq!(names(&descriptions.offered(nodes.iter(), &[own])), ["/robot/b/get_type_description"]);
    }
}
