// SPDX-License-Identifier: MIT OR Apache-2.0
//! Of each bench: experiments, payloads, lengths and rounds, as `settings.toml` has them.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Deserialize;
use tautline_harness::table::bytes_of;

use crate::Result;
use crate::plan::{Bench, Idle, Task};

/// How much of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Extent {
    Smoke,
    Quick,
    Full,
}

/// One setting of an experiment, for every mode that takes part.
#[derive(Clone, Debug)]
pub struct Setting {
    /// As in the JSON.
    pub experiment: String,
    pub task: Task,
    pub payload_bytes: usize,
    pub idle: Idle,
    pub budget: Duration,
    pub rounds: u32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    tasks: BTreeMap<String, Task>,
    settings: BTreeMap<Bench, BTreeMap<Extent, Vec<Line>>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    experiments: Vec<String>,
    bytes: Vec<String>,
    ms: u64,
    rounds: Option<u32>,
}

/// Those of a bench, in the order in which they are measured within an experiment.
///
/// # Errors
/// `settings.toml` names no size or no task where it should.
pub fn settings(bench: Bench, extent: Extent) -> Result<Vec<Setting>> {
    let mut file: File = toml::from_str(include_str!("../settings.toml"))?;
    let lines = file.settings.get_mut(&bench).and_then(|of| of.remove(&extent)).unwrap_or_default();
    let mut settings = Vec::new();
    for Line { experiments, bytes, ms, rounds } in lines {
        for bytes in bytes {
            let payload_bytes = bytes_of(&bytes).ok_or_else(|| format!("'{bytes}' is no size"))?;
            for experiment in &experiments {
                let name = experiment.replace("/held-off", "").replace("/as-shipped", "");
                settings.push(Setting {
                    experiment: experiment.clone(),
                    task: *file.tasks.get(&name).ok_or_else(|| format!("there is no task '{name}'"))?,
                    payload_bytes,
                    idle: if experiment.contains("/held-off") { Idle::HeldOff } else { Idle::AsShipped },
                    budget: Duration::from_millis(ms),
                    rounds: rounds.unwrap_or(1),
                });
            }
        }
    }
    Ok(settings)
}
