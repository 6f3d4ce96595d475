// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a port can be rung, and what was asked of it: written into its iceoryx2 port name, so that the list of a topic's
//! ports is also the list of the doorbells to ring and of the qualities of service.

use crate::compatibility::QosPolicyKind;
use crate::doorbell::{ArenaId, SLOTS};
use crate::qos::{Durability, History, Limits, Liveliness, Qos, Reliability};
use iceoryx2::prelude::PortName;
use std::time::Duration;

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
    /// Passes on what others sent, whatever quality of service they asked for.
    pub(crate) is_relay: bool,
}

impl Address {
    /// What keeps this publisher and the subscription `other` apart, or the other way round.
    pub(crate) fn incompatibility(&self, other: &Address) -> Option<QosPolicyKind> {
        if self.is_relay || other.is_relay {
            return None;
        }
        match self.role {
            Role::Subscription => other.qos.incompatibility(&self.qos),
            _ => self.qos.incompatibility(&other.qos),
        }
    }

    pub(crate) fn to_port_name(self) -> PortName {
        let role = match self.role {
            Role::Publisher => 'p',
            Role::TransientPublisher => 't',
            Role::Subscription => 's',
            Role::Keeper => 'k',
        };
        let role = if self.is_relay { role.to_ascii_uppercase() } else { role };
        // At most 1 + 1 + 16 + 1 + 4 + 1 + 4 + 5 + 1 + 3 * 10 of 64 characters.
        PortName::new(&format!("{role}:{}:{}:{}", self.arena, self.slot, qos_letters(self.qos)))
            .unwrap_or_else(|_| PortName::new_empty())
    }

    /// `None` for a port that is not Tautline's: it has no doorbell.
    pub(crate) fn parse(name: &str) -> Option<Self> {
        let mut parts = name.split(':');
        let letter = parts.next()?;
        let role = match letter.to_ascii_lowercase().as_str() {
            "p" => Role::Publisher,
            "t" => Role::TransientPublisher,
            "s" => Role::Subscription,
            "k" => Role::Keeper,
            _ => return None,
        };
        let is_relay = letter.chars().all(|letter| letter.is_ascii_uppercase());
        let arena = ArenaId(u64::from_str_radix(parts.next()?, 16).ok()?);
        let slot = parts.next()?.parse().ok().filter(|&slot| slot < SLOTS)?;
        let qos = parse_qos(parts.next()?, parts.next())?;
        Some(Address { role, arena, slot, qos, is_relay })
    }
}

/// What is asked of a port: `r` or `b` for the reliability, `v` or `t` for the durability, `a` or `m` for the liveliness, `l` or
/// `a` and the depth for the history; and if one of them is set, deadline, lifespan and lease.
fn qos_letters(qos: Qos) -> String {
    let reliability = if qos.reliability == Reliability::Reliable { 'r' } else { 'b' };
    let durability = if qos.durability == Durability::Volatile { 'v' } else { 't' };
    let history = if qos.history == History::KeepLast { 'l' } else { 'a' };
    let liveliness = if qos.liveliness == Liveliness::Automatic { 'a' } else { 'm' };
    let letters = format!("{reliability}{durability}{liveliness}{history}{}", qos.depth);
    let times = [qos.deadline, qos.lifespan, qos.liveliness_lease_duration];
    if times.iter().all(Option::is_none) { letters } else { letters + ":" + &times.map(digits).concat() }
}

/// The digits of a time in nanoseconds: 60 bits, 6 at a time. All of them set is none, and so is what is longer: 36 years.
const DIGITS: &[u8; 64] = b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz-_";
const TIME_DIGITS: usize = 10;
const NO_TIME: u64 = (1 << (6 * TIME_DIGITS)) - 1;

fn digits(time: Option<Duration>) -> String {
    let nanoseconds = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(NO_TIME).min(NO_TIME);
    let time_ns = time.map_or(NO_TIME, nanoseconds);
    let digit = |index: usize| DIGITS[(time_ns >> (6 * index)) as usize % DIGITS.len()];
    (0..TIME_DIGITS).rev().map(|index| char::from(digit(index))).collect()
}

/// `None` if these are no digits.
fn parse_time(digits: &str) -> Option<Option<Duration>> {
    let time_ns = digits.bytes().try_fold(0, |time_ns: u64, digit| {
        let value = DIGITS.iter().position(|known| *known == digit)?;
        Some(time_ns << 6 | value as u64)
    })?;
    // No time at all is no time that can be kept.
    (time_ns != 0).then(|| (time_ns != NO_TIME).then(|| Duration::from_nanos(time_ns)))
}

fn parse_qos(letters: &str, times: Option<&str>) -> Option<Qos> {
    let times = match times {
        None => [None; 3],
        Some(times) if times.is_ascii() && times.len() == 3 * TIME_DIGITS => {
            let time = |index: usize| parse_time(&times[index * TIME_DIGITS..(index + 1) * TIME_DIGITS]);
            [time(0)?, time(1)?, time(2)?]
        }
        Some(_) => return None,
    };
    let (flags, depth) = letters.split_at_checked(4)?;
    let flag = |index: usize, no: u8, yes: u8| match flags.as_bytes().get(index)? {
        letter if *letter == no => Some(false),
        letter if *letter == yes => Some(true),
        _ => None,
    };
    Some(Qos {
        reliability: if flag(0, b'r', b'b')? { Reliability::BestEffort } else { Reliability::Reliable },
        durability: if flag(1, b'v', b't')? { Durability::TransientLocal } else { Durability::Volatile },
        liveliness: if flag(2, b'a', b'm')? { Liveliness::ManualByTopic } else { Liveliness::Automatic },
        history: if flag(3, b'l', b'a')? { History::KeepAll } else { History::KeepLast },
        depth: depth.parse().ok().filter(|depth| (1..=Limits::MAX_DEPTH).contains(depth))?,
        deadline: times[0],
        lifespan: times[1],
        liveliness_lease_duration: times[2],
    })
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn round_trip_and_foreign_names() {
        let qos = Qos::keep_all(Limits::MAX_DEPTH).transient_local().best_effort();
        let role = Role::Subscription;
        let address = Address { role, arena: ArenaId(0xfeed), slot: 1023, qos, is_relay: false };
        let name = address.to_port_name();
        assert_eq!(name.as_str(), "s:000000000000feed:1023:btaa65536");
        assert!(Address::parse(name.as_str()).unwrap() == address);
        let relay = Address { qos: Qos::keep_last(1), is_relay: true, ..address };
        assert!(Address::parse(relay.to_port_name().as_str()).unwrap() == relay);
        let longest = Duration::from_nanos(NO_TIME - 1);
        for (deadline, lifespan, liveliness_lease_duration) in [
            (Some(Duration::from_nanos(1)), None, Some(longest)),
            (None, Some(Duration::new(3, 141_592_653)), None),
            (Some(longest), Some(longest), Some(longest)),
        ] {
            let liveliness = Liveliness::ManualByTopic;
            let qos = Qos { deadline, lifespan, liveliness, liveliness_lease_duration, ..qos };
            let timed = Address { qos, arena: ArenaId(u64::MAX), ..address };
            let name = timed.to_port_name();
            assert_eq!(name.as_str().len(), PortName::max_len(), "{name}");
            assert!(Address::parse(name.as_str()).unwrap() == timed, "{name}");
        }
        let century = Qos { deadline: Some(Duration::from_secs(3_153_600_000)), ..qos };
        let parsed = Address::parse(Address { qos: century, ..address }.to_port_name().as_str());
        assert_eq!(parsed.unwrap().qos.deadline, None);
        let foreign = [
            "",
            "s",
            "s:1",
            "s:zz:1:rval1",
            "s:1:1024:rval1",
            "x:1:1:rval1",
            "s:1:-1:rval1",
            "s:1:1",
            "s:1:1:rval",
            "s:1:1:rval1:",
            "s:1:1:rval1:0123456789",
            "s:1:1:rval1:000000000100000000010000000000",
            "s:1:1:rval1:00000000010000000001000000000!",
        ];
        for foreign in
            foreign.into_iter().chain(["s:1:1:rval0", "s:1:1:rvax1", "s:1:1:rv", "s:1:1:rval65537"])
        {
            assert!(Address::parse(foreign).is_none(), "{foreign}");
        }
    }
}
