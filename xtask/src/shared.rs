// SPDX-License-Identifier: MIT OR Apache-2.0
//! `cargo xtask test` builds a part of what `cargo xtask ci` builds. Cargo takes the one for the other only if each crate in both has the
//! same features and settings, and so has all that it needs; one feature of a small package that differs builds everything twice.

use crate::build::{WHOLE, most};
use crate::machine;
use crate::steps::{Outcome, cargo};
use serde_json::Value;
use std::collections::HashSet;
use std::hash::{DefaultHasher, Hash, Hasher};

/// Whether all that is built without Zenoh is of use to a build with it; otherwise the packages by which they differ.
pub fn check() -> Outcome {
    let graphs = (graph(&most()), graph(WHOLE));
    let (most, whole) = match graphs {
        (Ok(most), Ok(whole)) => (most, whole),
        (Err(reason), _) | (_, Err(reason)) => return Outcome::Failed(reason),
    };
    let built: HashSet<u64> = whole.iter().map(|unit| unit.hash).collect();
    let is_missing = |unit: &&Unit| !built.contains(&unit.hash);
    // Of what is built twice, that which is so for a reason of its own.
    let reasons: Vec<String> = most
        .iter()
        .filter(is_missing)
        .filter(|unit| unit.needs.iter().all(|hash| built.contains(hash)))
        .map(|unit| {
            let others = whole.iter().filter(|other| other.name == unit.name).map(|other| &other.settings);
            let others = others.cloned().collect::<Vec<_>>().join(" or ");
            format!("{} with {} in `test`, with {others} in `ci`", unit.name, unit.settings)
        })
        .collect();
    match most.iter().filter(is_missing).count() {
        0 => Outcome::Ok,
        count => Outcome::Failed(format!(
            "{count} of {} crates are built twice: {}. Give xtask/Cargo.toml the features that are missing.",
            most.len(),
            reasons.join("; ")
        )),
    }
}

/// A crate as it is built.
struct Unit {
    name: String,
    settings: String,
    hash: u64,
    /// Hashes of those that it needs.
    needs: Vec<u64>,
}

/// What cargo would build for the tests of these packages. To tell is an option that stable versions keep for nightly ones.
fn graph(packages: &str) -> Result<Vec<Unit>, String> {
    let mut command = cargo(&format!("test {packages} --no-run -Z unstable-options --unit-graph"));
    let output = command.env("RUSTC_BOOTSTRAP", "1").current_dir(machine::root()).output();
    let output = output.map_err(|error| format!("cargo: {error}"))?;
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).trim().to_owned());
    }
    let graph: Value = serde_json::from_slice(&output.stdout).map_err(|error| error.to_string())?;
    let units = graph["units"].as_array().ok_or("cargo's unit graph has no units")?;
    let mut hashes = vec![None; units.len()];
    (0..units.len())
        .map(|index| {
            let unit = &units[index];
            Ok(Unit {
                name: name(unit),
                settings: format!(
                    "{} {} {}",
                    unit["features"], unit["profile"]["debuginfo"], unit["profile"]["opt_level"]
                ),
                hash: hash(units, index, &mut hashes),
                needs: needs(unit).map(|index| hash(units, index, &mut hashes)).collect(),
            })
        })
        .collect()
}

fn name(unit: &Value) -> String {
    let package = unit["pkg_id"].as_str().unwrap_or_default();
    let package = package.rsplit_once(['#', '/']).map_or(package, |(_, name)| name);
    format!("{package} ({} {})", unit["target"]["name"], unit["mode"])
}

fn needs(unit: &Value) -> impl Iterator<Item = usize> {
    let dependencies = unit["dependencies"].as_array().into_iter().flatten();
    dependencies.filter_map(|dependency| usize::try_from(dependency["index"].as_u64()?).ok())
}

/// Of a crate, its settings, and those of all that it needs.
fn hash(units: &[Value], index: usize, known: &mut [Option<u64>]) -> u64 {
    if let Some(hash) = known[index] {
        return hash;
    }
    let unit = &units[index];
    let mut below: Vec<u64> = needs(unit).map(|index| hash(units, index, known)).collect();
    below.sort_unstable();
    let mut hasher = DefaultHasher::new();
    for field in ["pkg_id", "target", "profile", "platform", "mode", "features"] {
        unit[field].to_string().hash(&mut hasher);
    }
    below.hash(&mut hasher);
    *known[index].insert(hasher.finish())
}
