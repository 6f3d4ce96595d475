// SPDX-License-Identifier: MIT OR Apache-2.0
//! Liveliness tokens: a session's announcements of its nodes, publishers, subscriptions, services and clients.

use super::key::parse_domain;
use super::names::{Mangled, TypeId, is_token, mangled_namespace, namespace, topic};
use super::{MAX_KEY_BYTES, MAX_NAME_BYTES, Malformed, WireQos, decimal};
use std::fmt;

const ADMIN: &str = "@ros2_lv";

/// Number of parts of a node's token, and of an endpoint's without its suffix.
const NODE_PARTS: usize = 9;
const ENDPOINT_PARTS: usize = 13;
/// Number of fields of a QoS.
const QOS_FIELDS: usize = 6;

/// The suffix of a volatile subscription that takes plain samples only. From rmw_zenoh 0.10.5 on, volatile publishers of types
/// with an unbounded `uint8[]` serve it on [`TopicKey::cpu_group`](super::TopicKey::cpu_group).
pub const CPU_BACKEND: &str = "backends:cpu:";

/// A node's names.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeName {
    /// SROS 2 enclave; `/` when there is none.
    pub enclave: String,
    /// Absolute; `/` for the root.
    pub namespace: String,
    /// Without the namespace.
    pub name: String,
}

impl NodeName {
    /// A node without an enclave.
    pub fn new(namespace: &str, name: &str) -> Self {
        NodeName { enclave: "/".into(), namespace: namespace.into(), name: name.into() }
    }

    /// `/namespace/name`.
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }
}

/// The kind of an endpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum EndpointKind {
    /// `MP`
    Publisher,
    /// `MS`
    Subscription,
    /// `SS`
    Service,
    /// `SC`
    Client,
}

impl EndpointKind {
    fn as_str(self) -> &'static str {
        match self {
            EndpointKind::Publisher => "MP",
            EndpointKind::Subscription => "MS",
            EndpointKind::Service => "SS",
            EndpointKind::Client => "SC",
        }
    }
}

/// An endpoint in a token.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Endpoint {
    /// Number among the session's nodes and endpoints.
    pub id: u64,
    /// Publisher, subscription, service or client.
    pub kind: EndpointKind,
    /// The topic's or the service's fully qualified name.
    pub name: String,
    /// Type and hash.
    pub type_id: TypeId,
    /// Quality of service.
    pub qos: WireQos,
    /// The rest: empty up to rmw_zenoh 0.10.4, later an endpoint's buffer backends, such as [`CPU_BACKEND`]. Stored unchanged,
    /// because the GID is computed from it too. Its parts are valid in a key and separated by `/`.
    pub suffix: String,
}

/// A node, or an endpoint and its node. Its `Display` is the token's key expression in its canonical form.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Token {
    /// ROS domain.
    pub domain: u32,
    /// Zenoh's session id, untrusted: a token may contain any.
    pub zid: u128,
    /// Number of the node in the session.
    pub node_id: u64,
    /// The node's names.
    pub node: NodeName,
    /// `None`: the token is a node's.
    pub endpoint: Option<Endpoint>,
    /// A part after a node's name, or a field after an endpoint's QoS. rmw_zenoh reads neither, and computes GIDs without them. Valid in
    /// a key, without '/'; empty: there is none.
    pub note: String,
}

impl Token {
    /// Parses a token's key expression. Further parts of an endpoint's token are kept; those of a node's token after the note are
    /// dropped, as in rmw_zenoh.
    pub fn parse(key: &str) -> Result<Self, Malformed> {
        if key.len() > MAX_KEY_BYTES {
            return Err(Malformed::KeyTooLong);
        }
        let mut parts = key.split('/');
        let mut next = || parts.next().ok_or(Malformed::Parts);
        if next()? != ADMIN {
            return Err(Malformed::Admin);
        }
        let domain = parse_domain(next()?)?;
        let zid = parse_zid(next()?)?;
        let node_id = decimal(next()?).ok_or(Malformed::Id)?;
        let id = decimal(next()?).ok_or(Malformed::Id)?;
        let kind = match next()? {
            "NN" => None,
            "MP" => Some(EndpointKind::Publisher),
            "MS" => Some(EndpointKind::Subscription),
            "SS" => Some(EndpointKind::Service),
            "SC" => Some(EndpointKind::Client),
            _ => return Err(Malformed::Kind),
        };
        let (enclave, space, name) = (namespace(next()?)?, namespace(next()?)?, next()?);
        if name.len() > MAX_NAME_BYTES || !is_token(name) {
            return Err(Malformed::NodeName);
        }
        let node = NodeName { enclave, namespace: space, name: name.into() };
        let (endpoint, note) = match kind {
            None if id != node_id => return Err(Malformed::Id),
            None => (None, suffix(key, NODE_PARTS)?.split('/').next().unwrap_or_default()),
            Some(kind) => {
                let name = topic(next()?)?;
                let type_id = TypeId::parse(next()?, next()?)?;
                let text = next()?;
                let (qos, note) = match text.match_indices(':').nth(QOS_FIELDS - 1) {
                    Some((at, _)) => (&text[..at], &text[at + 1..]),
                    None => (text, ""),
                };
                let qos = WireQos::parse(qos)?;
                // The note is checked as well.
                suffix(key, ENDPOINT_PARTS - 1)?;
                let suffix = suffix(key, ENDPOINT_PARTS)?.into();
                (Some(Endpoint { id, kind, name, type_id, qos, suffix }), note)
            }
        };
        Ok(Token { domain, zid, node_id, node, endpoint, note: note.into() })
    }

    /// The text from which peers compute an endpoint's GID: the token without its note.
    pub(super) fn without_note(&self) -> impl fmt::Display {
        Text { token: self, note: "" }
    }
}

/// Writes a token with this note.
struct Text<'a> {
    token: &'a Token,
    note: &'a str,
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Text { token: self, note: &self.note }.fmt(f)
    }
}

impl fmt::Display for Text<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Text { token: Token { domain, zid, node_id, node, endpoint, .. }, note } = self;
        let NodeName { enclave, namespace, name } = node;
        let id = endpoint.as_ref().map_or(*node_id, |endpoint| endpoint.id);
        let kind = endpoint.as_ref().map_or("NN", |endpoint| endpoint.kind.as_str());
        write!(f, "{ADMIN}/{domain}/{zid:x}/{node_id}/{id}/{kind}")?;
        write!(f, "/{}/{}/{name}", mangled_namespace(enclave), mangled_namespace(namespace))?;
        let note = |f: &mut fmt::Formatter<'_>, separator: char| match note.is_empty() {
            true => Ok(()),
            false => write!(f, "{separator}{note}"),
        };
        let Some(Endpoint { name, type_id, qos, suffix, .. }) = endpoint else { return note(f, '/') };
        write!(f, "/{}/{}/{}/{qos}", Mangled(name), type_id.dds_name(), type_id.hash)?;
        note(f, ':')?;
        if suffix.is_empty() { Ok(()) } else { write!(f, "/{suffix}") }
    }
}

/// Matches every token of `domain`.
pub fn token_wildcard(domain: u32) -> String {
    format!("{ADMIN}/{domain}/**")
}

/// The key after its first `known` parts: empty, or parts that are valid in a key without wildcards.
fn suffix(key: &str, known: usize) -> Result<&str, Malformed> {
    let Some(text) = key.splitn(known + 1, '/').nth(known) else { return Ok("") };
    if text.contains(['*', '$', '?', '#']) || text.split('/').any(str::is_empty) {
        return Err(Malformed::Suffix);
    }
    Ok(text)
}

/// Parses a session id in Zenoh's form: lower case, no leading zero.
fn parse_zid(text: &str) -> Result<u128, Malformed> {
    let hex = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
    if !(1..=32).contains(&text.len()) || text.starts_with('0') || !text.bytes().all(hex) {
        return Err(Malformed::Zid);
    }
    u128::from_str_radix(text, 16).map_err(|_| Malformed::Zid)
}
