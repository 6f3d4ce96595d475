// SPDX-License-Identifier: MIT OR Apache-2.0
//! Liveliness tokens: what a session says of its nodes, publishers, subscriptions, services and clients.

use super::key::parse_domain;
use super::names::{Mangled, TypeId, is_token, mangled_namespace, namespace, topic};
use super::{MAX_KEY_BYTES, MAX_NAME_BYTES, Malformed, WireQos, decimal};
use std::fmt;

const ADMIN: &str = "@ros2_lv";

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

/// Which end of what.
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

/// What a token says of an endpoint.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Endpoint {
    /// Number among the session's nodes and endpoints.
    pub id: u64,
    /// Which end of what.
    pub kind: EndpointKind,
    /// The topic's or the service's fully qualified name.
    pub name: String,
    /// Type and hash.
    pub type_id: TypeId,
    /// Quality of service.
    pub qos: WireQos,
}

/// A node, or an endpoint and the node it belongs to. Its `Display` is the token's key expression, in the canonical
/// form that gids are computed from.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Token {
    /// ROS domain.
    pub domain: u32,
    /// Zenoh's session id: a claim, whoever declares a token can write any.
    pub zid: u128,
    /// Number of the node among those of the session.
    pub node_id: u64,
    /// The node's names.
    pub node: NodeName,
    /// `None`: the token is the node's own.
    pub endpoint: Option<Endpoint>,
}

impl Token {
    /// Reads a token's key expression. A suffix that newer versions of rmw_zenoh append is let through and forgotten.
    ///
    /// # Errors
    /// [`Malformed`].
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
        let endpoint = match kind {
            None if id != node_id => return Err(Malformed::Id),
            None => None,
            Some(kind) => {
                let name = topic(next()?)?;
                let type_id = TypeId::parse(next()?, next()?)?;
                Some(Endpoint { id, kind, name, type_id, qos: WireQos::parse(next()?)? })
            }
        };
        Ok(Token { domain, zid, node_id, node, endpoint })
    }
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let NodeName { enclave, namespace, name } = &self.node;
        let id = self.endpoint.as_ref().map_or(self.node_id, |endpoint| endpoint.id);
        let kind = self.endpoint.as_ref().map_or("NN", |endpoint| endpoint.kind.as_str());
        write!(f, "{ADMIN}/{}/{:x}/{}/{id}/{kind}", self.domain, self.zid, self.node_id)?;
        write!(f, "/{}/{}/{name}", mangled_namespace(enclave), mangled_namespace(namespace))?;
        if let Some(Endpoint { name, type_id, qos, .. }) = &self.endpoint {
            write!(f, "/{}/{}/{}/{qos}", Mangled(name), type_id.dds_name(), type_id.hash)?;
        }
        Ok(())
    }
}

/// Matches every token of `domain`.
pub fn token_wildcard(domain: u32) -> String {
    format!("{ADMIN}/{domain}/**")
}

/// As Zenoh writes it: lower case, no leading zero.
fn parse_zid(text: &str) -> Result<u128, Malformed> {
    let hex = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
    if !(1..=32).contains(&text.len()) || text.starts_with('0') || !text.bytes().all(hex) {
        return Err(Malformed::Zid);
    }
    u128::from_str_radix(text, 16).map_err(|_| Malformed::Zid)
}
