// SPDX-License-Identifier: MIT OR Apache-2.0
//! Valid names of nodes, topics, services and types.

/// Maximum length of a name, as in ROS 2.
pub(crate) const MAX_NAME_BYTES: usize = 255;
/// Prefixes of the two topics that a service consists of. Other names of topics cannot contain ':'.
pub(crate) const REQUESTS: &str = "request:";
pub(crate) const RESPONSES: &str = "response:";
/// Prefix of a type hash, and number of digits after it.
pub(crate) const HASH_PREFIX: &str = "RIHS01_";
pub(crate) const HASH_DIGITS: usize = 64;

/// Whether this is an absolute name of ROS tokens, such as `/a/b`.
pub(crate) fn is_absolute(name: &str) -> bool {
    name.len() <= MAX_NAME_BYTES && name.strip_prefix('/').is_some_and(|rest| rest.split('/').all(is_token))
}

pub(crate) fn is_token(token: &str) -> bool {
    !token.is_empty() && token.chars().all(is_token_char)
}

pub(crate) fn is_token_char(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '_'
}

/// Whether a topic can have this name. Allows more than ROS 2, but no control characters, which a terminal would interpret.
pub(crate) fn is_topic(name: &str) -> bool {
    let bare = name.strip_prefix(REQUESTS).or_else(|| name.strip_prefix(RESPONSES)).unwrap_or(name);
    (1..=MAX_NAME_BYTES).contains(&bare.len()) && bare.chars().all(|c| !c.is_control() && c != ':')
}

/// Whether a type can have this name and hash. Allows names that are not names of ROS 2 types.
pub(crate) fn is_type(name: &str, hash: Option<&str>) -> bool {
    let is_name =
        (1..=MAX_NAME_BYTES).contains(&name.len()) && name.bytes().all(|byte| byte.is_ascii_graphic());
    is_name && hash.is_none_or(is_hash)
}

/// Whether this is `RIHS01_` and 64 hexadecimal digits.
pub(crate) fn is_hash(hash: &str) -> bool {
    hash.strip_prefix(HASH_PREFIX).is_some_and(|digits| {
        digits.len() == HASH_DIGITS && digits.bytes().all(|digit| digit.is_ascii_hexdigit())
    })
}

/// The service whose requests go over this topic.
pub(crate) fn service_of(topic: &str) -> Option<&str> {
    topic.strip_prefix(REQUESTS)
}

/// Whether a topic carries a service's requests or responses.
pub(crate) fn is_of_service(topic: &str) -> bool {
    topic.starts_with(REQUESTS) || topic.starts_with(RESPONSES)
}
