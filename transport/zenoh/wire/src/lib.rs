// SPDX-License-Identifier: MIT OR Apache-2.0
//! The wire format of rmw_zenoh (ROS 2 Jazzy and later), as text and bytes: no I/O, no Zenoh.
//!
//! All parsed input comes from the network and is untrusted. Each parser is bounded by the limits below, allocates at most the
//! length of its input, never panics, and returns the reason as [`Malformed`].
//!
//! | module | holds |
//! |---|---|
//! | `key` | [`TopicKey`]: the key expression of a topic's data |
//! | `token` | [`Token`]: the liveliness token of a node or an endpoint |
//! | `qos` | [`WireQos`]: the thirteenth part of an endpoint's token |
//! | `attachment` | [`Attachment`]: the 33 bytes beside each sample |
//! | `payload` | the 4 bytes before each body |
//! | `gid` | [`endpoint_gid`]: an endpoint's GID, from its token |
#![forbid(unsafe_code)]

mod attachment;
mod gid;
mod key;
mod names;
mod payload;
mod qos;
mod token;

pub use attachment::Attachment;
pub use gid::endpoint_gid;
pub use key::TopicKey;
pub use names::{TypeId, is_absolute};
pub use payload::{ENCAPSULATION, check_encapsulation};
pub use qos::{WireDuration, WireQos};
pub use token::{CPU_BACKEND, Endpoint, EndpointKind, NodeName, Token, token_wildcard};

/// Longest key expression to parse, in bytes. ROS 2's limits of names permit less; the rest is for a token's suffix.
pub const MAX_KEY_BYTES: usize = 2048;
/// Longest name of a topic, a service, a namespace or a node, in bytes: ROS 2's limit.
pub const MAX_NAME_BYTES: usize = 255;
/// Maximum depth in a token; more is malformed.
pub const MAX_DEPTH: u64 = 1 << 32;

/// Why bytes from the network were refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, thiserror::Error)]
#[non_exhaustive]
pub enum Malformed {
    /// Longer than any valid key.
    #[error("key longer than {MAX_KEY_BYTES} bytes")]
    KeyTooLong,
    /// Too few or too many parts between slashes.
    #[error("wrong number of parts in the key")]
    Parts,
    /// Not `@ros2_lv`.
    #[error("not a token of rmw_zenoh")]
    Admin,
    /// Not a number from 0 to 232.
    #[error("domain out of range")]
    Domain,
    /// Not 1 to 32 hexadecimal digits without a leading zero.
    #[error("malformed session id")]
    Zid,
    /// Not a decimal number of 64 bits.
    #[error("malformed node or endpoint id")]
    Id,
    /// Not NN, MP, MS, SS or SC.
    #[error("unknown kind of entity")]
    Kind,
    /// A node's name, namespace or enclave.
    #[error("malformed node name")]
    NodeName,
    /// A topic's or a service's name.
    #[error("malformed topic name")]
    TopicName,
    /// Not `package::msg::dds_::Name_`.
    #[error("malformed type name")]
    TypeName,
    /// Not `RIHS01_` and 64 hexadecimal digits.
    #[error("malformed type hash")]
    TypeHash,
    /// The QoS of a token.
    #[error("malformed QoS")]
    Qos,
    /// The part after an endpoint's QoS, or a node's name: a wildcard or an empty part.
    #[error("malformed suffix of a token")]
    Suffix,
    /// No attachment: not from rmw_zenoh.
    #[error("no attachment")]
    NoAttachment,
    /// Not 33 bytes with a GID of 16.
    #[error("malformed attachment")]
    Attachment,
    /// Shorter than the 4 bytes of encapsulation.
    #[error("payload shorter than its encapsulation")]
    PayloadTooShort,
    /// Not XCDR1 little-endian.
    #[error("encapsulation other than XCDR1 little-endian")]
    Encapsulation,
    /// Over the gateway's limit.
    #[error("payload over the size limit")]
    PayloadTooLong,
}

/// A decimal number as the encoder writes it: no sign, no leading zero.
fn decimal(text: &str) -> Option<u64> {
    let canonical = text == "0" || !text.starts_with('0');
    (canonical && text.bytes().all(|byte| byte.is_ascii_digit())).then(|| text.parse().ok())?
}

#[cfg(test)]
mod tests;
