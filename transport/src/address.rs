// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a port can be rung: written into its iceoryx2 port name, so that the list of a topic's ports is also the list
//! of the doorbells to ring.

use crate::doorbell::{ArenaId, SLOTS};
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
}

impl Address {
    pub(crate) fn to_port_name(self) -> PortName {
        let role = match self.role {
            Role::Publisher => 'p',
            Role::TransientPublisher => 't',
            Role::Subscription => 's',
            Role::Keeper => 'k',
        };
        // At most 1 + 1 + 16 + 1 + 4 of 64 characters.
        PortName::new(&format!("{role}:{}:{}", self.arena, self.slot))
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
        Some(Address { role, arena, slot })
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn round_trip_and_foreign_names() {
        let address = Address { role: Role::Subscription, arena: ArenaId(0xfeed), slot: 1023 };
        let name = address.to_port_name();
        assert_eq!(name.as_str(), "s:000000000000feed:1023");
        assert!(Address::parse(name.as_str()).unwrap() == address);
        for foreign in ["", "s", "s:1", "s:zz:1", "s:1:1024", "x:1:1", "s:1:-1"] {
            assert!(Address::parse(foreign).is_none(), "{foreign}");
        }
    }
}
