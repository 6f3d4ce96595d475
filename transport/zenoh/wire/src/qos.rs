// SPDX-License-Identifier: MIT OR Apache-2.0
//! QoS in a token: `rel:dur:hist,depth:deadline:lifespan:liveliness,lease`; each number is omitted if it is the default.

use super::{MAX_DEPTH, Malformed, decimal};
use std::fmt;
use std::time::Duration;
use tautline_transport::{Durability, History, Reliability};

/// A duration on the wire, in seconds and nanoseconds, each omitted separately.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct WireDuration {
    /// Whole seconds.
    pub sec: u64,
    /// Nanoseconds; below one second from correct peers, unchecked.
    pub nsec: u64,
}

impl WireDuration {
    /// ROS 2's infinity: the greatest `i64` of nanoseconds.
    pub const INFINITE: WireDuration = WireDuration { sec: 9_223_372_036, nsec: 854_775_807 };

    /// Converts a duration. `None` and times beyond ROS 2's range become infinite.
    pub fn from_duration(duration: Option<Duration>) -> Self {
        let exact = |d: Duration| WireDuration { sec: d.as_secs(), nsec: d.subsec_nanos().into() };
        let longest = Duration::from_nanos(i64::MAX as u64);
        duration.filter(|&d| d < longest).map_or(Self::INFINITE, exact)
    }

    /// Converts to a duration; `None` if this is infinite, or longer than a [`Duration`].
    pub fn to_duration(self) -> Option<Duration> {
        if self == Self::INFINITE {
            return None;
        }
        Duration::from_secs(self.sec).checked_add(Duration::from_nanos(self.nsec))
    }

    fn parse<'a>(mut next: impl FnMut() -> Option<&'a str>) -> Result<Self, Malformed> {
        let sec = number(next(), Self::INFINITE.sec)?;
        Ok(WireDuration { sec, nsec: number(next(), Self::INFINITE.nsec)? })
    }
}

impl fmt::Display for WireDuration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_unless(f, self.sec, Self::INFINITE.sec)?;
        f.write_str(",")?;
        write_unless(f, self.nsec, Self::INFINITE.nsec)
    }
}

/// QoS in a token. Its `Display` is the canonical text: receivers write it again from the parsed QoS to compute GIDs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct WireQos {
    /// Reliable or best effort.
    pub reliability: Reliability,
    /// Volatile or transient local.
    pub durability: Durability,
    /// Keep last or keep all.
    pub history: History,
    /// Depth, in samples. 42 if a peer omits it; 0 is possible with keep-all.
    pub depth: u64,
    /// Longest time between samples.
    pub deadline: WireDuration,
    /// Age at which a sample is no longer delivered.
    pub lifespan: WireDuration,
    /// Whether liveliness is manual by topic.
    pub manual_liveliness: bool,
    /// Liveliness lease.
    pub lease: WireDuration,
}

const DEFAULT_DEPTH: u64 = 42;

impl WireQos {
    /// Parses the part of a token after the type's hash.
    ///
    /// # Errors
    /// [`Malformed::Qos`].
    pub fn parse(text: &str) -> Result<Self, Malformed> {
        let mut fields = text.split(':');
        let mut next = || fields.next().ok_or(Malformed::Qos);
        let (reliability, durability, history) = (next()?, next()?, next()?);
        let (deadline, lifespan, liveliness) = (next()?, next()?, next()?);
        if fields.next().is_some() {
            return Err(Malformed::Qos);
        }
        let (history, depth) = history.split_once(',').ok_or(Malformed::Qos)?;
        let depth = number(Some(depth), DEFAULT_DEPTH)?;
        if depth > MAX_DEPTH {
            return Err(Malformed::Qos);
        }
        let two = |text: &str| {
            let mut parts = text.split(',');
            let duration = WireDuration::parse(|| parts.next())?;
            parts.next().map_or(Ok(duration), |_| Err(Malformed::Qos))
        };
        let (liveliness, lease) = liveliness.split_once(',').ok_or(Malformed::Qos)?;
        Ok(WireQos {
            reliability: match reliability {
                "" | "0" | "1" => Reliability::Reliable,
                "2" => Reliability::BestEffort,
                _ => return Err(Malformed::Qos),
            },
            durability: match durability {
                "" | "0" | "2" => Durability::Volatile,
                "1" => Durability::TransientLocal,
                _ => return Err(Malformed::Qos),
            },
            history: match history {
                "" | "0" | "1" => History::KeepLast,
                "2" => History::KeepAll,
                _ => return Err(Malformed::Qos),
            },
            depth,
            deadline: two(deadline)?,
            lifespan: two(lifespan)?,
            manual_liveliness: match liveliness {
                "" | "0" | "1" => false,
                // 2 is ROS 2's abandoned MANUAL_BY_NODE, which some peers still send.
                "2" | "3" => true,
                _ => return Err(Malformed::Qos),
            },
            lease: two(lease)?,
        })
    }
}

impl Default for WireQos {
    /// Reliable, volatile, keep last 42: `::,:,:,:,,`.
    fn default() -> Self {
        WireQos {
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            history: History::KeepLast,
            depth: DEFAULT_DEPTH,
            deadline: WireDuration::INFINITE,
            lifespan: WireDuration::INFINITE,
            manual_liveliness: false,
            lease: WireDuration::INFINITE,
        }
    }
}

impl fmt::Display for WireQos {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let reliability = if self.reliability == Reliability::BestEffort { "2" } else { "" };
        let durability = if self.durability == Durability::TransientLocal { "1" } else { "" };
        let history = if self.history == History::KeepAll { "2" } else { "" };
        write!(f, "{reliability}:{durability}:{history},")?;
        write_unless(f, self.depth, DEFAULT_DEPTH)?;
        let liveliness = if self.manual_liveliness { "3" } else { "" };
        write!(f, ":{}:{}:{liveliness},{}", self.deadline, self.lifespan, self.lease)
    }
}

fn write_unless(f: &mut fmt::Formatter<'_>, value: u64, default: u64) -> fmt::Result {
    if value == default { Ok(()) } else { write!(f, "{value}") }
}

fn number(text: Option<&str>, default: u64) -> Result<u64, Malformed> {
    match text {
        Some("") => Ok(default),
        Some(text) => decimal(text).ok_or(Malformed::Qos),
        None => Err(Malformed::Qos),
    }
}
