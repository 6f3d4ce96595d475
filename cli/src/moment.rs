// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recorded moments of callbacks, in a form that can be saved.

use serde::{Deserialize, Serialize};
use tautline_analysis::taken::{Seen, Taken};
pub use tautline_executor::MomentKind as Kind;

/// The resolution at which core time is accounted. Shorter intervals, and smaller delays of a wake-up, may be missing.
pub const ACCOUNTED_TO_NS: u64 = 100_000;

/// A [`tautline_executor::Moment`] that can be serialized.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Moment {
    #[serde(with = "KindName")]
    pub kind: Kind,
    pub from_ns: u64,
    pub to_ns: u64,
    pub length_ns: u64,
}

#[derive(Serialize, Deserialize)]
#[serde(remote = "Kind", rename_all = "snake_case")]
enum KindName {
    Late,
    Taken,
    WokenLate,
    Overran,
    Served,
    Waited,
}

impl From<&tautline_executor::Moment> for Moment {
    fn from(moment: &tautline_executor::Moment) -> Moment {
        let tautline_executor::Moment { kind, from_ns, to_ns, length_ns } = *moment;
        Moment { kind, from_ns, to_ns, length_ns }
    }
}

impl Moment {
    /// The moment as an interval that the analysis accounts for. A late job is `None`, because it is an effect of such intervals.
    pub fn taken(&self) -> Option<Taken> {
        let seen = match self.kind {
            Kind::Late => return None,
            Kind::Taken => Seen::Running,
            Kind::WokenLate => Seen::WokenLate,
            Kind::Overran | Kind::Served => Seen::Overran,
            Kind::Waited => Seen::Waited,
        };
        let Moment { from_ns, to_ns, length_ns, .. } = *self;
        Some(Taken { from_ns, to_ns, length_ns, seen })
    }
}
