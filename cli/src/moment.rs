// SPDX-License-Identifier: MIT OR Apache-2.0
//! Moments of callbacks in the form in which they are saved and passed between processes.

use serde::{Deserialize, Serialize};
use tautline_analysis::taken::{Seen, Taken};
use tautline_executor::MomentKind;

/// The resolution of core time accounting: shorter intervals and smaller delays of a wake-up may be missing.
pub const ACCOUNTED_TO_NS: u64 = 100_000;

/// A [`tautline_executor::Moment`] that can be serialized.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Moment {
    pub kind: Kind,
    pub from_ns: u64,
    pub to_ns: u64,
    pub length_ns: u64,
}

/// A [`MomentKind`] that can be serialized.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    Late,
    Taken,
    WokenLate,
    Overran,
    Served,
    Waited,
}

impl From<&tautline_executor::Moment> for Moment {
    fn from(moment: &tautline_executor::Moment) -> Moment {
        let kind = match moment.kind {
            MomentKind::Late => Kind::Late,
            MomentKind::Taken => Kind::Taken,
            MomentKind::WokenLate => Kind::WokenLate,
            MomentKind::Overran => Kind::Overran,
            MomentKind::Served => Kind::Served,
            MomentKind::Waited => Kind::Waited,
        };
        let tautline_executor::Moment { from_ns, to_ns, length_ns, .. } = *moment;
        Moment { kind, from_ns, to_ns, length_ns }
    }
}

impl Moment {
    /// The interval for the analysis; `None` for a late job, which is a result and not a cause.
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
