// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where ends and nodes were first, as tokens say it: in their enclave, which is free text to rmw_zenoh and part of what gids are
//! computed from. `/tautline/<tag>/<times over ROS>/<place>/<domain>/<domain>...`, numbers in hexadecimal.

use crate::wire::{NodeName, Token, endpoint_gid};
use tautline_transport::{Gid, Origin};

/// Below it gateways say which publishers have ended by themselves, for a while, as tokens, which come in the order in which they are
/// declared: `@tautline_ended/<domain>/<zid>/<tag>`. What ends without that word has died. No other program listens.
pub(crate) const ENDED: &str = "@tautline_ended";

/// The word that a publisher has ended.
pub(crate) fn ended(domain: u32, zid: u128, tag: u64) -> String {
    format!("{ENDED}/{domain}/{zid:x}/{tag:016x}")
}

/// All such words of a domain.
pub(crate) fn ended_wildcard(domain: u32) -> String {
    format!("{ENDED}/{domain}/**")
}

/// Whose word that is, and the tag of the publisher that it is about; a claim.
pub(crate) fn ended_tag(key: &str) -> Option<(u128, u64)> {
    let mut parts = key.strip_prefix(ENDED)?.split('/').skip(2);
    let (zid, tag) = (parts.next()?, parts.next()?);
    Some((u128::from_str_radix(zid, 16).ok()?, u64::from_str_radix(tag, 16).ok()?))
        .filter(|_| parts.next().is_none())
}

const OURS: &str = "/tautline/";
/// What is no gateway's token's is on the network itself.
const PLACE: &str = "zenoh";

/// A node's names with where it, or its end, was first.
pub(crate) fn named(node: &NodeName, origin: &Origin) -> NodeName {
    let Origin { tag, path, ros, place } = origin;
    // A part of a name is not empty.
    let place = if place.is_empty() { "_" } else { place };
    let path: String = path.iter().map(|domain| format!("/{domain:016x}")).collect();
    NodeName { enclave: format!("{OURS}{tag:016x}/{ros:x}/{place}{path}"), ..node.clone() }
}

/// Where what a token stands for was first: as it says, or, if it is no gateway's, where it is.
pub(crate) fn origin(token: &Token) -> Origin {
    said(&token.node.enclave).unwrap_or_else(|| {
        let gid = match token.endpoint {
            Some(_) => endpoint_gid(token),
            None => Gid((token.zid ^ u128::from(token.node_id) << 64).to_le_bytes()),
        };
        Origin::here(gid, PLACE)
    })
}

/// What an enclave says; it is a claim.
fn said(enclave: &str) -> Option<Origin> {
    let mut parts = enclave.strip_prefix(OURS)?.split('/');
    let number = |text: &str| u64::from_str_radix(text, 16).ok();
    let tag = number(parts.next()?)?;
    let ros = u8::from_str_radix(parts.next()?, 16).ok()?;
    let place = parts.next()?;
    let path = parts.map(number).collect::<Option<Vec<u64>>>()?;
    let is_short = place.len() <= Origin::MOST_PLACE_BYTES && path.len() <= Origin::MOST_HOPS;
    let place = if place == "_" { String::new() } else { place.to_owned() };
    is_short.then_some(Origin { tag, path, ros, place })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::MAX_NAME_BYTES;

    #[test]
    fn what_is_written_is_read() {
        let far = Origin {
            tag: u64::MAX,
            path: vec![u64::MAX; Origin::MOST_HOPS],
            ros: 255,
            place: "x".repeat(Origin::MOST_PLACE_BYTES),
        };
        let node = NodeName::new("/robot", "n");
        for origin in [far, Origin::default(), Origin::here(Gid([3; 16]), "host").told_by(7)] {
            let named = named(&node, &origin);
            assert!(named.enclave.len() <= MAX_NAME_BYTES);
            let token = Token { domain: 5, zid: 1, node_id: 2, node: named, endpoint: None };
            let parsed = Token::parse(&token.to_string()).unwrap();
            assert_eq!(super::origin(&parsed), origin);
        }
    }

    #[test]
    fn the_word_of_an_end_is_read() {
        for tag in [1, u64::MAX] {
            assert_eq!(ended_tag(&ended(5, 0xAB, tag)), Some((0xAB, tag)));
        }
        assert!(
            ["@tautline_ended", "@tautline_ended/5/1/x", "@tautline_ended/5/1/1/1", "@ros2_lv/5/1/1"]
                .iter()
                .all(|key| ended_tag(key).is_none())
        );
    }

    #[test]
    fn what_no_gateway_writes_is_the_networks_own() {
        for enclave in ["/", "/secure/robot", "/tautline/x/0/_", "/tautline/1/0", "/tautline/1/0/_/y"] {
            let node = NodeName { enclave: enclave.into(), ..NodeName::new("/", "n") };
            let token = |node_id| Token { domain: 5, zid: 1, node_id, node: node.clone(), endpoint: None };
            let [one, other] = [1, 2].map(|id| origin(&token(id)));
            assert!(one.path.is_empty() && one.tag != 0 && one.tag != other.tag, "{enclave}: {one:?}");
            assert_eq!(one.place, "zenoh");
        }
    }
}
