// SPDX-License-Identifier: MIT OR Apache-2.0
//! Origins of endpoints and nodes in tokens: in the note, which rmw_zenoh does not read.
//! `tautline,<tag>,<times over ROS>,<place>,<domain>,<domain>...`, numbers in hexadecimal.

use crate::wire::{Token, endpoint_gid};
use tautline_transport::{Gid, Origin};

/// Prefix of announcements that a publisher ended normally, kept for a while as liveliness tokens, which arrive in order:
/// `@tautline_ended/<domain>/<zid>/<tag>`. A publisher that ends without one has died. Only gateways subscribe to them.
pub(crate) const ENDED: &str = "@tautline_ended";

/// The announcement that a publisher ended normally.
pub(crate) fn ended(domain: u32, zid: u128, tag: u64) -> String {
    format!("{ENDED}/{domain}/{zid:x}/{tag:016x}")
}

/// Matches all announcements of a domain that a publisher ended normally.
pub(crate) fn ended_wildcard(domain: u32) -> String {
    format!("{ENDED}/{domain}/**")
}

/// Parses such an announcement: the announcing session, and the publisher's tag; untrusted.
pub(crate) fn ended_tag(key: &str) -> Option<(u128, u64)> {
    let mut parts = key.strip_prefix(ENDED)?.split('/').skip(2);
    let (zid, tag) = (parts.next()?, parts.next()?);
    Some((u128::from_str_radix(zid, 16).ok()?, u64::from_str_radix(tag, 16).ok()?))
        .filter(|_| parts.next().is_none())
}

const OURS: &str = "tautline,";
/// The place of entities whose token no gateway declared.
const PLACE: &str = "zenoh";

pub(crate) fn note(origin: &Origin) -> String {
    let Origin { tag, path, ros, place } = origin;
    let path: String = path.iter().map(|domain| format!(",{domain:016x}")).collect();
    format!("{OURS}{tag:016x},{ros:x},{place}{path}")
}

/// The origin that a token states, or the entity's own, if no gateway declared it.
pub(crate) fn origin(token: &Token) -> Origin {
    parse(&token.note).unwrap_or_else(|| {
        let gid = match token.endpoint {
            Some(_) => endpoint_gid(token),
            None => Gid((token.zid ^ u128::from(token.node_id) << 64).to_le_bytes()),
        };
        Origin::here(gid, PLACE)
    })
}

/// Parses a note, which is untrusted.
fn parse(note: &str) -> Option<Origin> {
    let mut parts = note.strip_prefix(OURS)?.split(',');
    let number = |text: &str| u64::from_str_radix(text, 16).ok();
    let tag = number(parts.next()?)?;
    let ros = u8::from_str_radix(parts.next()?, 16).ok()?;
    let place = parts.next()?.to_owned();
    let path = parts.map(number).collect::<Option<Vec<u64>>>()?;
    Some(Origin { tag, path, ros, place }).filter(Origin::is_valid)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::NodeName;

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
            let (node, note) = (node.clone(), note(&origin));
            let token = Token { domain: 5, zid: 1, node_id: 2, node, endpoint: None, note };
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
        for note in ["", "other", "tautline,x,0,", "tautline,1,0", "tautline,1,0,,y", "tautline,1,0,a b"] {
            let node = NodeName::new("/", "n");
            let token = |node_id| {
                let (node, note) = (node.clone(), note.into());
                Token { domain: 5, zid: 1, node_id, node, endpoint: None, note }
            };
            let [one, other] = [1, 2].map(|id| origin(&token(id)));
            assert!(one.path.is_empty() && one.tag != 0 && one.tag != other.tag, "{note}: {one:?}");
            assert_eq!(one.place, "zenoh");
        }
    }
}
