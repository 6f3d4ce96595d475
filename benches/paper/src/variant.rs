// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paper's variants of the subscriber: how callbacks are executed, and with which priorities.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::PaperError;

/// How sampling and callbacks are spread over threads; see [`structures`](crate::structures) for each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Structure {
    /// One thread: sampling and callbacks take turns.
    Futures,
    /// All callbacks joined into one task of a thread pool.
    FuturesJoin,
    /// The proposed one: a thread and a priority for each callback.
    FuturesRt,
    /// A thread pool of two.
    FuturesThreadPool,
    /// One thread for sampling, one for all callbacks.
    Futures2Threads,
    /// Tokio as it comes; its threads have the sampler's priority.
    Tokio,
    /// Tokio with workers below the sampler.
    TokioRt,
}

/// Which threads get which priority.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Scheduling {
    /// `SCHED_FIFO`, sampler and middleware above the callbacks.
    Fifo,
    /// `SCHED_OTHER` for the whole subscriber: the prefix `nort`.
    Other,
    /// `SCHED_FIFO`, but sampler and middleware below the callbacks.
    MiddlewareBelow,
    /// `SCHED_FIFO` for the callbacks and what the program starts itself; the middleware's own threads are `SCHED_OTHER`.
    MiddlewareOther,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Variant {
    pub structure: Structure,
    pub scheduling: Scheduling,
}

const NAMES: [(Structure, &str); 7] = [
    (Structure::Futures, "futures"),
    (Structure::FuturesJoin, "futures-join"),
    (Structure::FuturesRt, "futures-rt"),
    (Structure::FuturesThreadPool, "futures-thread-pool"),
    (Structure::Futures2Threads, "futures-2-threads"),
    (Structure::Tokio, "tokio"),
    (Structure::TokioRt, "tokio-rt"),
];

impl Variant {
    pub const FUTURES_RT: Variant = Variant::new(Structure::FuturesRt, Scheduling::Fifo);

    pub const fn new(structure: Structure, scheduling: Scheduling) -> Variant {
        Variant { structure, scheduling }
    }

    /// Every R2R variant of the paper, then the same without real-time priorities, then its ablation of the middleware's
    /// priority: below the callbacks, and none.
    pub fn all() -> Vec<Variant> {
        let with = |scheduling| NAMES.map(|(structure, _)| Variant::new(structure, scheduling));
        let mut all = with(Scheduling::Fifo).to_vec();
        // Without priorities, tokio-rt is tokio.
        all.extend(with(Scheduling::Other).into_iter().filter(|v| v.structure != Structure::TokioRt));
        let ablation = [Scheduling::MiddlewareBelow, Scheduling::MiddlewareOther];
        all.extend(ablation.map(|scheduling| Variant::new(Structure::FuturesRt, scheduling)));
        all
    }

    /// Whether this is `futures-rt` with the middleware's priority taken away.
    pub fn is_ablation(self) -> bool {
        matches!(self.scheduling, Scheduling::MiddlewareBelow | Scheduling::MiddlewareOther)
    }

    pub fn is_realtime(self) -> bool {
        self.scheduling != Scheduling::Other
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name =
            NAMES.iter().find(|(structure, _)| *structure == self.structure).map_or("?", |(_, name)| name);
        match self.scheduling {
            Scheduling::Fifo => f.write_str(name),
            Scheduling::Other => write!(f, "nort-{name}"),
            Scheduling::MiddlewareBelow => write!(f, "{name}-mw-below"),
            Scheduling::MiddlewareOther => write!(f, "{name}-mw-other"),
        }
    }
}

impl FromStr for Variant {
    type Err = PaperError;

    fn from_str(text: &str) -> Result<Variant, PaperError> {
        let all = Variant::all();
        let found = all.iter().find(|variant| variant.to_string() == text).copied();
        found.ok_or_else(|| PaperError::UnknownVariant {
            name: text.to_owned(),
            known: all.iter().map(Variant::to_string).collect::<Vec<_>>().join(", "),
        })
    }
}

impl TryFrom<String> for Variant {
    type Error = PaperError;

    fn try_from(text: String) -> Result<Variant, PaperError> {
        text.parse()
    }
}

impl From<Variant> for String {
    fn from(variant: Variant) -> String {
        variant.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_variants_are_there_by_its_names() {
        let names: Vec<_> = Variant::all().iter().map(Variant::to_string).collect();
        assert_eq!(
            names.join(" "),
            "futures futures-join futures-rt futures-thread-pool futures-2-threads tokio tokio-rt nort-futures \
             nort-futures-join nort-futures-rt nort-futures-thread-pool nort-futures-2-threads nort-tokio \
             futures-rt-mw-below futures-rt-mw-other"
        );
    }

    #[test]
    fn names_lead_back_to_their_variants() {
        for variant in Variant::all() {
            assert_eq!(variant.to_string().parse::<Variant>().unwrap(), variant);
        }
        let error = "futures-tr".parse::<Variant>().unwrap_err().to_string();
        assert!(error.contains("'futures-tr'") && error.contains("futures-2-threads"), "{error}");
    }
}
