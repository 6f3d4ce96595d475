// SPDX-License-Identifier: MIT OR Apache-2.0
//! Plays the topics of a node of the system file in its place, on its core and at its priority, and marks the run for the report.

use super::args::{PRIORITY, PlayArgs};
use std::collections::BTreeSet;
use std::path::PathBuf;
use taut_cli::arguments::full_name;
use taut_cli::report::watch::ObservedProcesses;
use taut_cli::verb::{Failure, Outcome};
use tautline_analysis::file::{CallbackEntry, SystemFile};
use tautline_executor::{ProcessInfo, StatisticsFile};
use tautline_rt::{CoreSet, Policy};
use tautline_transport::Participant;

/// A node of a system file whose topics are played.
pub struct StandIn {
    path: PathBuf,
    file: SystemFile,
    node: String,
}

impl PlayArgs {
    /// The node of `--as`, if it was given.
    pub(super) fn stand_in(&self, domain: u32) -> Outcome<Option<StandIn>> {
        let Some(node) = &self.stands_in else { return Ok(None) };
        let of_environment =
            || std::env::var_os("TAUT_SYSTEM").filter(|path| !path.is_empty()).map(PathBuf::from);
        let path = match self.system.clone().or_else(of_environment) {
            Some(path) => path,
            None => {
                let mut processes = ObservedProcesses::new(domain);
                let found = processes.refresh().and_then(|()| processes.system_path());
                found.map_err(|error| {
                    Failure::unusable(format!("--as needs a system file: {error}; or name it with --system"))
                })?
            }
        };
        let path = std::path::absolute(&path).unwrap_or(path);
        let file = SystemFile::read(&path)?;
        let nodes: BTreeSet<_> = file.callbacks().iter().map(|callback| callback.node.clone()).collect();
        if !nodes.contains(node) {
            let list = format!("check {}", path.display());
            return Err(Failure::unknown("node", node, nodes.iter().map(String::as_str), &list));
        }
        let stand_in = StandIn { path, node: node.clone(), file };
        if stand_in.topics().next().is_none() {
            return Err(Failure::unusable(format!(
                "{node} publishes nothing, by {}: there is nothing to play for it",
                stand_in.path.display()
            )));
        }
        Ok(Some(stand_in))
    }
}

impl StandIn {
    fn callbacks(&self) -> impl Iterator<Item = &CallbackEntry> {
        self.file.callbacks().iter().filter(|callback| callback.node == self.node)
    }

    /// The topics that the node publishes.
    pub fn topics(&self) -> impl Iterator<Item = String> {
        let topics = self.callbacks().flat_map(|callback| &callback.publishes);
        topics.map(|topic| full_name(topic)).collect::<BTreeSet<_>>().into_iter()
    }

    /// The callback with the highest priority among those that publish; playing takes its place.
    fn first(&self) -> Option<&CallbackEntry> {
        self.callbacks()
            .filter(|callback| !callback.publishes.is_empty())
            .max_by_key(|callback| callback.priority)
    }

    /// The callback's priority; for a reservation, which is above all priorities, the highest one that is used.
    pub fn priority(&self) -> u8 {
        const HIGHEST: u8 = 98;
        self.first().map_or(PRIORITY, |callback| callback.priority.min(HIGHEST))
    }

    /// The node's cores.
    pub fn cores(&self) -> CoreSet {
        let core = self.first().and_then(|callback| self.file.cores().get(callback.core));
        core.map_or(CoreSet::empty(), |core| CoreSet::one(core.number))
    }

    /// The node's name and namespace.
    ///
    /// # Errors
    /// The node itself is running.
    pub fn name(&self, participant: &Participant) -> Outcome<(String, String)> {
        let full = full_name(&self.node);
        let graph = participant.graph()?;
        if let Some(live) = graph.nodes.iter().find(|node| node.name.to_string() == full) {
            let of = live.pid.map_or(String::new(), |pid| format!(" (process {pid})"));
            return Err(Failure::unusable(format!(
                "{full}{of} runs itself: end it before something is played in its place"
            )));
        }
        let (namespace, name) = full.rsplit_once('/').unwrap_or(("", &full));
        let namespace = if namespace.is_empty() { "/" } else { namespace };
        Ok((name.to_owned(), namespace.to_owned()))
    }

    /// Creates the statistics file by which `taut report` sees that the node is played.
    pub fn show(&self, domain: u32, policy: Policy) -> Outcome<StatisticsFile> {
        let core = self.first().and_then(|callback| self.file.cores().get(callback.core));
        let about = ProcessInfo {
            host: core.map_or(String::new(), |core| core.host.clone()),
            realtime: matches!(policy, Policy::Fifo(_)),
            system_path: self.path.clone(),
            system_hash: self.file.fingerprint(),
            stands_in: self.node.clone(),
            ..ProcessInfo::of_this()
        };
        let shown = StatisticsFile::create(&StatisticsFile::prefix(domain), &about);
        shown.map_err(|error| Failure::unusable(format!("the statistics in /dev/shm: {error}")))
    }
}
