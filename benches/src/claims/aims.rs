// SPDX-License-Identifier: MIT OR Apache-2.0
//! The aims of `bench domain`, whose numbers are of processes and topics: their rows have a size and a unit instead of modes and rounds.

use super::{BadClaims, FILE, File};
use serde::{Deserialize, Serialize};

/// The most that a number of `bench domain` shall be.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Aim {
    pub what: String,
    /// None: all.
    #[serde(default)]
    pub experiments: Vec<String>,
    /// None: all.
    #[serde(default)]
    pub sizes: Vec<u64>,
    /// The column that is judged.
    #[serde(default)]
    pub of: Column,
    pub at_most: f64,
}

/// A column of `bench domain`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Column {
    /// The median, or the number if it is one.
    #[default]
    P50,
    /// Of fewer than 100 times the longest.
    P99,
    Max,
}

impl Column {
    pub fn name(self) -> &'static str {
        match self {
            Column::P50 => "p50",
            Column::P99 => "p99",
            Column::Max => "max",
        }
    }
}

/// The aims of `bench domain`.
///
/// # Errors
/// The file cannot be read.
pub fn aims() -> Result<Vec<Aim>, BadClaims> {
    let file: Result<File, _> = toml::from_str(FILE);
    file.map(|file| file.aim).map_err(|error| BadClaims(error.to_string()))
}

impl Aim {
    /// Whether it is about this experiment at this size; then it is judged there, or something is missing.
    pub fn is_of(&self, experiment: &str, size: u64) -> bool {
        let is_experiment =
            self.experiments.is_empty() || self.experiments.iter().any(|one| one == experiment);
        is_experiment && (self.sizes.is_empty() || self.sizes.contains(&size))
    }
}
