// SPDX-License-Identifier: MIT OR Apache-2.0
//! The systems and their ways.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Command;

use serde::Deserialize;

use crate::Result;

/// All systems, in the order of the tables.
pub const SYSTEMS: [&str; 11] = [
    "floor",
    "tautline",
    "iceoryx2",
    "taktora",
    "fastdds",
    "cyclonedds",
    "r2r",
    "zenoh",
    "hiroz",
    "copper",
    "dora",
];

/// How a system's processes are started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// This one, with `--child`.
    Own,
    /// This one, with a gateway for each end.
    Gateways,
    /// A program of this name, which takes its job as JSON.
    Json(&'static str),
    /// The same beside a daemon: a program of the second name.
    Daemon(&'static str, &'static str),
}

/// What a mode takes part in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Everything.
    All,
    /// Round trips.
    RoundTrips,
    /// Round trips with idle states as shipped, for it decides about them itself.
    AsShipped,
    /// Round trips of payloads that are written and read whole.
    Whole,
    /// The same with idle states held off alone, for nobody sleeps: a floor.
    Copy,
    /// Round trips of 64 B.
    Small,
    /// Flows of many topics.
    Topics,
    /// Requests and their responses.
    Requests,
    /// The same of 64 B.
    SmallRequests,
}

/// A way of a system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mode {
    pub system: &'static str,
    pub mode: &'static str,
    pub program: Program,
    /// Both processes on the receiver's core.
    pub one_core: bool,
    pub part: Part,
}

impl Mode {
    /// Its system's and its own.
    pub fn name(&self) -> String {
        format!("{} {}", self.system, self.mode)
    }

    /// Whether a sender that is faster than its receiver is held back, rather than losing messages.
    pub fn holds_sender_back(&self, payload_bytes: usize) -> bool {
        // See `systems.toml`.
        match (self.system, self.mode) {
            ("cyclonedds", "shared-memory") => false,
            ("r2r", _) => payload_bytes <= 64 << 10,
            _ => true,
        }
    }
}

const fn own(system: &'static str, mode: &'static str, part: Part) -> Mode {
    Mode { system, mode, program: Program::Own, one_core: false, part }
}

const fn json(system: &'static str, mode: &'static str, part: Part) -> Mode {
    Mode { program: Program::Json(system), ..own(system, mode, part) }
}

/// All of them, rivals in question next to each other.
pub const MODES: &[Mode] = &[
    own("floor", "futex", Part::RoundTrips),
    own("floor", "ring", Part::Topics),
    Mode { one_core: true, ..own("floor", "one-core", Part::RoundTrips) },
    own("floor", "memcpy", Part::Copy),
    own("tautline", "blocking", Part::All),
    own("tautline", "direct", Part::All),
    own("tautline", "one-thread", Part::Topics),
    own("tautline", "direct-spin", Part::RoundTrips),
    Mode { one_core: true, ..own("tautline", "one-core", Part::RoundTrips) },
    own("tautline", "two-cores", Part::RoundTrips),
    own("tautline", "busy-poll", Part::RoundTrips),
    own("tautline", "image", Part::RoundTrips),
    own("tautline", "own-default", Part::AsShipped),
    Mode { program: Program::Gateways, ..own("tautline", "gateway", Part::Whole) },
    own("tautline", "topics", Part::Requests),
    own("tautline", "service", Part::Requests),
    own("tautline", "service-owned", Part::SmallRequests),
    own("iceoryx2", "waitset", Part::All),
    own("iceoryx2", "busy-poll", Part::RoundTrips),
    own("iceoryx2", "request-response", Part::Requests),
    json("taktora", "items", Part::RoundTrips),
    json("fastdds", "default", Part::All),
    json("fastdds", "tuned", Part::All),
    json("fastdds", "data-sharing", Part::All),
    json("cyclonedds", "default", Part::All),
    json("cyclonedds", "tuned", Part::All),
    Mode { program: Program::Daemon("cyclonedds", ROUDI), ..json("cyclonedds", "shared-memory", Part::All) },
    json("r2r", "typed", Part::All),
    json("r2r", "native", Part::All),
    json("r2r", "loaned", Part::Small),
    json("r2r", "service", Part::Requests),
    json("zenoh", "tcp", Part::All),
    json("zenoh", "tcp-ordinary", Part::All),
    json("zenoh", "shm", Part::All),
    json("hiroz", "pub-sub", Part::RoundTrips),
];

/// What is said of systems and modes, as `systems.toml` has it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Texts {
    /// What was set, by system and mode.
    pub settings: BTreeMap<String, String>,
    /// What a rival does better, whatever the figures say.
    pub strengths: BTreeMap<String, String>,
    /// What else was asked for, and why it is not measured.
    pub not_joined: BTreeMap<String, String>,
}

pub fn texts() -> Result<Texts> {
    Ok(toml::from_str(include_str!("../systems.toml"))?)
}

/// Names of programs that are no system: the gateway, the one with the demo, and iceoryx's daemon.
pub const GATEWAY: &str = "gateway";
/// See [`GATEWAY`].
pub const TAUT: &str = "taut";
/// See [`GATEWAY`].
pub const ROUDI: &str = "roudi";

/// Where the rivals' programs are, or why they are not.
pub struct Programs {
    paths: BTreeMap<String, PathBuf>,
    missing: BTreeMap<String, String>,
}

impl Programs {
    /// Of `NAME=PATH` and `NAME=REASON`.
    pub fn new(programs: &[String], without: &[String]) -> Result<Self> {
        let split = |text: &String| -> Result<(String, String)> {
            let (name, rest) = text.split_once('=').ok_or_else(|| format!("{text}: not NAME=..."))?;
            let others = [GATEWAY, TAUT, ROUDI];
            if !others.contains(&name) && !SYSTEMS.contains(&name) {
                let names = [&SYSTEMS[..], &others].concat().join(", ");
                return Err(format!("{name} is none of {names}").into());
            }
            Ok((name.to_owned(), rest.to_owned()))
        };
        let paths = programs.iter().map(|text| split(text).map(|(name, path)| (name, path.into())));
        Ok(Programs {
            paths: paths.collect::<Result<_>>()?,
            missing: without.iter().map(split).collect::<Result<_>>()?,
        })
    }

    /// A system's program.
    pub fn find(&self, name: &str) -> std::result::Result<&PathBuf, String> {
        let path = self.paths.get(name);
        path.ok_or_else(|| self.missing.get(name).cloned().unwrap_or_else(|| NOT_BUILT.to_owned()))
    }

    /// What a program says that it was built with.
    pub fn version(&self, name: &str) -> Option<String> {
        let output = Command::new(self.paths.get(name)?).arg("version").output().ok()?;
        let text = String::from_utf8(output.stdout).ok()?;
        Some(text.trim().to_owned()).filter(|text| !text.is_empty())
    }
}

const NOT_BUILT: &str = "its program was not named: cargo xtask bench builds it";

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_mode_has_its_text_and_nothing_else_has() {
        let texts = texts().unwrap();
        let modes: BTreeSet<String> = MODES.iter().map(Mode::name).collect();
        assert_eq!(texts.settings.into_keys().collect::<BTreeSet<_>>(), modes);
        let has_modes = |system: &str| MODES.iter().any(|mode| mode.system == system);
        for system in SYSTEMS {
            assert_ne!(has_modes(system), texts.not_joined.contains_key(system), "{system}");
            let is_rival = !["floor", "tautline"].contains(&system);
            assert_eq!(is_rival, texts.strengths.contains_key(system), "{system}");
        }
        let names = texts.strengths.keys().chain(texts.not_joined.keys());
        assert!(
            names.clone().all(|name| SYSTEMS.contains(&name.as_str())),
            "{:?}",
            names.collect::<Vec<_>>()
        );
    }
}
