// SPDX-License-Identifier: MIT OR Apache-2.0
//! `cargo xtask test` builds a part of what `cargo xtask ci` builds, and workspaces that are apart need much of the same. Cargo takes the one for
//! the other only if each crate in both has the same version, features and settings, and so has all that it needs; one feature of a small package
//! that differs builds everything twice.

use crate::build::{WHOLE, most};
use crate::steps::{cargo, json_of};
use crate::with_ros::RMW;
use crate::{bridge, lab, machine, programs};
use serde_json::Value;
use std::collections::HashSet;
use std::hash::{DefaultHasher, Hash, Hasher};

/// Whether all that is built without Zenoh is of use to a build with it, and what is not ours to the workspaces that are apart; otherwise the
/// packages by which they differ.
pub fn check() -> Result<(), String> {
    let apart = [
        ("bridge-ros", bridge::WHOLE),
        ("rmw", RMW),
        ("r2r-programs", programs::WHOLE),
        ("benches", lab::WHOLE),
    ];
    let apart = apart.map(|(name, arguments)| (name, arguments.to_owned()));
    let parts = [("test", most())].into_iter().chain(apart);
    let whole = graph(WHOLE)?;
    let faults = parts.filter_map(|(name, arguments)| match graph(&arguments) {
        Ok(part) => compare(name, &part, &whole),
        Err(reason) => Some(format!("{name}: {reason}")),
    });
    match faults.collect::<Vec<_>>().join("; ") {
        faults if faults.is_empty() => Ok(()),
        faults => Err(format!(
            "{faults}. If features differ, give xtask/features or xtask/host-features those that are missing; if versions do, `cargo update --precise` \
             in the workspace named; if debuginfo or opt_level do, its [profile.dev] the root's"
        )),
    }
}

/// What of a part is built anew for the whole, if anything is.
fn compare(part: &str, units: &[Unit], whole: &[Unit]) -> Option<String> {
    let built: HashSet<u64> = whole.iter().map(|unit| unit.hash).collect();
    let known: HashSet<&str> = whole.iter().map(|unit| &*unit.name).collect();
    // To another workspace our crates are other ones.
    let is_apart = part != "test";
    // The encoder beside which a bench measures has two small crates of Zenoh's, with other features than the gateway's.
    let is_an_encoders = |unit: &&Unit| part == "benches" && unit.name.starts_with("zenoh-");
    let is_missing = |unit: &&Unit| {
        !built.contains(&unit.hash) && !(is_apart && (unit.is_ours || !known.contains(&*unit.name)))
    };
    // Of what is built twice, that which is so for a reason of its own.
    let reasons: Vec<String> = units
        .iter()
        .filter(|unit| is_missing(unit) && !is_an_encoders(unit))
        .filter(|unit| unit.needs.iter().all(|hash| built.contains(hash)))
        .map(|unit| {
            let others = whole.iter().filter(|other| other.name == unit.name).map(|other| &other.settings);
            let others = others.cloned().collect::<Vec<_>>().join(" or ");
            format!("{} with {}, in `ci` with {others}", unit.name, unit.settings)
        })
        .collect();
    let count = units.iter().filter(|unit| is_missing(unit) && !is_an_encoders(unit)).count();
    (count != 0)
        .then(|| format!("{part}: {count} of {} crates are built twice: {}", units.len(), reasons.join("; ")))
}

/// A crate as it is built.
pub struct Unit {
    /// Of its package, without what a compatible version may differ in, and of its target.
    pub name: String,
    is_ours: bool,
    settings: String,
    hash: u64,
    /// Hashes of those that it needs.
    needs: Vec<u64>,
}

/// What cargo would build for the tests of these packages.
fn graph(packages: &str) -> Result<Vec<Unit>, String> {
    units(&format!("test {packages} --no-run"))
}

/// What cargo would build.
pub fn units(command: &str) -> Result<Vec<Unit>, String> {
    let units = unit_graph(command)?;
    let mut hashes = vec![None; units.len()];
    (0..units.len())
        .map(|index| {
            let unit = &units[index];
            Ok(Unit {
                name: name(unit),
                is_ours: id(unit).starts_with("path+"),
                settings: format!(
                    "{} {} {} {}",
                    version(unit),
                    unit["features"],
                    unit["profile"]["debuginfo"],
                    unit["profile"]["opt_level"]
                ),
                hash: hash(&units, index, &mut hashes),
                needs: needs(unit).map(|index| hash(&units, index, &mut hashes)).collect(),
            })
        })
        .collect()
}

/// Cargo's own words for it. To tell is an option that stable versions keep for nightly ones.
pub fn unit_graph(command: &str) -> Result<Vec<Value>, String> {
    let mut command = cargo(&format!("{command} -Z unstable-options --unit-graph"));
    let mut graph = json_of(command.env("RUSTC_BOOTSTRAP", "1").current_dir(machine::root()))?;
    match graph["units"].take() {
        Value::Array(units) => Ok(units),
        _ => Err("cargo's unit graph has no units".to_owned()),
    }
}

fn id(unit: &Value) -> &str {
    unit["pkg_id"].as_str().unwrap_or_default()
}

fn version(unit: &Value) -> &str {
    id(unit).rsplit_once(['#', '@']).map_or("", |(_, version)| version)
}

fn name(unit: &Value) -> String {
    let package = id(unit).rsplit_once(['#', '@']).map_or(id(unit), |(package, _)| package);
    let package = package.rsplit_once(['#', '/']).map_or(package, |(_, name)| name);
    let mut numbers = version(unit).split('.');
    let series = match (numbers.next().unwrap_or_default(), numbers.next()) {
        ("0", Some(minor)) => format!("0.{minor}"),
        (major, _) => major.to_owned(),
    };
    format!("{package} {series} ({} {})", unit["target"]["name"], unit["mode"])
}

/// Where in the graph that is which it needs.
pub fn needs(unit: &Value) -> impl Iterator<Item = usize> {
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
