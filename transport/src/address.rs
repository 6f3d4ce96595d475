// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a port can be rung, and what was asked of it: written into its iceoryx2 port name, so that the list of a topic's
//! ports is also the list of the doorbells to ring and of the qualities of service.

use crate::doorbell::{ArenaId, SLOTS};
use crate::qos::{Durability, History, Limits, Qos, Reliability};
use iceoryx2::prelude::PortName;

/// The part that a port plays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    Publisher,
    TransientPublisher,
    Subscription,
    /// Keeps a publisher's last samples for late joiners; is not rung.
    Keeper,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct Address {
    pub(crate) role: Role,
    pub(crate) arena: ArenaId,
    pub(crate) slot: usize,
    pub(crate) qos: Qos,
}

impl Address {
    pub(crate) fn to_port_name(self) -> PortName {
        let role = match self.role {
            Role::Publisher => 'p',
            Role::TransientPublisher => 't',
            Role::Subscription => 's',
            Role::Keeper => 'k',
        };
        // At most 1 + 1 + 16 + 1 + 4 + 1 + 3 + 5 of 64 characters.
        PortName::new(&format!("{role}:{}:{}:{}", self.arena, self.slot, qos_letters(self.qos)))
            .unwrap_or_else(|_| PortName::new_empty())
    }

    /// `None` for a port that is not Tautline's: it has no doorbell.
    pub(crate) fn parse(name: &str) -> Option<Self> {
        let mut parts = name.split(':');
        let role = match parts.next()? {
            "p" => Role::Publisher,
            "t" => Role::TransientPublisher,
            "s" => Role::Subscription,
            "k" => Role::Keeper,
            _ => return None,
        };
        let arena = ArenaId(u64::from_str_radix(parts.next()?, 16).ok()?);
        let slot = parts.next()?.parse().ok().filter(|&slot| slot < SLOTS)?;
        let qos = parse_qos(parts.next()?)?;
        Some(Address { role, arena, slot, qos })
    }
}

/// What is asked of a port: `r` or `b` for the reliability, `v` or `t` for the durability, `l` or `a` and the depth for
/// the history.
fn qos_letters(qos: Qos) -> String {
    let reliability = if qos.reliability == Reliability::Reliable { 'r' } else { 'b' };
    let durability = if qos.durability == Durability::Volatile { 'v' } else { 't' };
    let history = if qos.history == History::KeepLast { 'l' } else { 'a' };
    format!("{reliability}{durability}{history}{}", qos.depth)
}

fn parse_qos(letters: &str) -> Option<Qos> {
    let (flags, depth) = letters.split_at_checked(3)?;
    let flag = |index: usize, no: u8, yes: u8| match flags.as_bytes().get(index)? {
        letter if *letter == no => Some(false),
        letter if *letter == yes => Some(true),
        _ => None,
    };
    Some(Qos {
        reliability: if flag(0, b'r', b'b')? { Reliability::BestEffort } else { Reliability::Reliable },
        durability: if flag(1, b'v', b't')? { Durability::TransientLocal } else { Durability::Volatile },
        history: if flag(2, b'l', b'a')? { History::KeepAll } else { History::KeepLast },
        depth: depth.parse().ok().filter(|depth| (1..=Limits::MAX_DEPTH).contains(depth))?,
        deadline: None,
        lifespan: None,
    })
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn round_trip_and_foreign_names() {
        let qos = Qos::keep_all(Limits::MAX_DEPTH).transient_local().best_effort();
        let address = Address { role: Role::Subscription, arena: ArenaId(0xfeed), slot: 1023, qos };
        let name = address.to_port_name();
        assert_eq!(name.as_str(), "s:000000000000feed:1023:bta65536");
        assert!(Address::parse(name.as_str()).unwrap() == address);
        let plain = Address { qos: Qos::keep_last(1), ..address };
        assert!(Address::parse(plain.to_port_name().as_str()).unwrap() == plain);
        let foreign = [
            "",
            "s",
            "s:1",
            "s:zz:1:rvl1",
            "s:1:1024:rvl1",
            "x:1:1:rvl1",
            "s:1:-1:rvl1",
            "s:1:1",
            "s:1:1:rvl",
        ];
        for foreign in foreign.into_iter().chain(["s:1:1:rvl0", "s:1:1:rvx1", "s:1:1:rv", "s:1:1:rvl65537"]) {
            assert!(Address::parse(foreign).is_none(), "{foreign}");
        }
    }
}
