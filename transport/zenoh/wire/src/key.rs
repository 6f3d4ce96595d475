// SPDX-License-Identifier: MIT OR Apache-2.0
//! `0/chatter/std_msgs::msg::dds_::String_/RIHS01_df66...`: the key of a topic's samples and a service's requests.

use super::names::{TypeId, is_absolute};
use super::{MAX_KEY_BYTES, Malformed, decimal};
use std::fmt;
use tautline_transport::MAX_DOMAIN;

/// A topic on the network. Its `Display` is the key expression.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicKey {
    /// ROS domain, 0 to 232.
    pub domain: u32,
    /// The fully qualified name, such as `/chatter`.
    pub topic: String,
    /// The type.
    pub type_id: TypeId,
}

impl TopicKey {
    /// Parses a key expression.
    pub fn parse(key: &str) -> Result<Self, Malformed> {
        if key.len() > MAX_KEY_BYTES {
            return Err(Malformed::KeyTooLong);
        }
        let (domain, rest) = key.split_once('/').ok_or(Malformed::Parts)?;
        let (rest, hash) = rest.rsplit_once('/').ok_or(Malformed::Parts)?;
        let (topic, name) = rest.rsplit_once('/').ok_or(Malformed::Parts)?;
        let topic = format!("/{topic}");
        if !is_absolute(&topic) {
            return Err(Malformed::TopicName);
        }
        Ok(TopicKey { domain: parse_domain(domain)?, topic, type_id: TypeId::parse(name, hash)? })
    }

    /// The key on which publishers of rmw_zenoh 0.10.5 or newer put samples instead, in the same encoding, for subscriptions
    /// whose tokens end in [`CPU_BACKEND`](super::CPU_BACKEND).
    pub fn cpu_group(&self) -> String {
        format!("{self}/_buf_cpu")
    }
}

impl fmt::Display for TopicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = self.topic.trim_matches('/');
        write!(f, "{}/{name}/{}/{}", self.domain, self.type_id.dds_name(), self.type_id.hash)
    }
}

pub(super) fn parse_domain(text: &str) -> Result<u32, Malformed> {
    let domain = decimal(text).and_then(|number| u32::try_from(number).ok());
    domain.filter(|&domain| domain <= MAX_DOMAIN).ok_or(Malformed::Domain)
}
