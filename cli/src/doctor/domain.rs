// SPDX-License-Identifier: MIT OR Apache-2.0
//! Faults in a domain: mixed versions, duplicate names, incompatible endpoints, files of killed processes, too little shared memory.

use super::finding::{Checked, Finding};
use super::host::Tree;
use crate::compatibility;
use crate::table::whereabouts;
use indicatif::BinaryBytes;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tautline::TransportError;
use tautline_rt::domain::{all_shared_folders, shared_folder};
use tautline_rt::shm::{self, PeerFile};
use tautline_trace::is_trace_file;
use tautline_transport::{GraphSnapshot, NodeInfo, Visitor, is_dead_domain, remove_dead_domain};

/// The memory of a minimal process: its context, the domain's file and the trace file (docs/memory.md).
const LEAST_BYTES: u64 = 6 << 20;

/// All findings about a domain; `tree` contains the size of its shared memory.
pub fn findings(tree: &Tree, domain: u32) -> Vec<Finding> {
    let mut findings = match read_graph(domain) {
        Ok((graph, left_out)) => {
            let mut findings = versions(&left_out);
            findings.extend(one_or_good("node names", names(&graph), || {
                format!("{} nodes in domain {domain}, each name once", graph.nodes.len())
            }));
            findings.extend(one_or_good("qos", mismatches(&graph), || {
                format!("the ends of all topics of domain {domain} fit each other")
            }));
            findings
        }
        // The domain's own file is of another version.
        Err(error @ TransportError::Version { .. }) => versions(&[error]),
        Err(error) => vec![Finding::of("domain", Err(error.to_string()))],
    };
    findings.push(Finding::of("left behind", left_behind(domain)));
    findings.push(Finding::of("shared memory", memory(tree, domain)));
    findings
}

fn read_graph(domain: u32) -> Result<(Arc<GraphSnapshot>, Vec<TransportError>), TransportError> {
    let mut visitor = Visitor::new(domain)?;
    let graph = visitor.graph()?;
    Ok((graph, visitor.left_out()))
}

fn one_or_good(check: &'static str, found: Vec<Finding>, good: impl Fn() -> String) -> Vec<Finding> {
    let found = if found.is_empty() { vec![Finding::good(good())] } else { found };
    found.into_iter().map(|finding| Finding { check, ..finding }).collect()
}

fn versions(left_out: &[TransportError]) -> Vec<Finding> {
    let bad = |error: &TransportError| {
        Finding::bad(error.to_string())
            .fix("build all programs of the domain with one version of Tautline (docs/troubleshooting.md)")
    };
    one_or_good("versions", left_out.iter().map(bad).collect(), || {
        "all processes of the domain understand each other".into()
    })
}

fn names(graph: &GraphSnapshot) -> Vec<Finding> {
    let twice = graph.nodes.chunk_by(|one, other| one.name == other.name).filter(|same| same.len() > 1);
    let bad = |same: &[Arc<NodeInfo>]| {
        let places = same.iter().map(|node| whereabouts(node)).collect::<Vec<_>>().join(", ");
        Finding::bad(format!("{} nodes are called {}: {places}", same.len(), same[0].name))
            .fix("rename one: --ros-args -r __node:=NAME; which of them answers requests for its parameters is chance")
    };
    twice.map(bad).collect()
}

/// Incompatible publishers and subscriptions, by topic and reason.
fn mismatches(graph: &GraphSnapshot) -> Vec<Finding> {
    let mut pairs: BTreeMap<(&str, String), BTreeSet<String>> = BTreeMap::new();
    for found in compatibility::mismatches(graph) {
        let pair = format!(
            "{} -> {}",
            compatibility::label(found.publisher),
            compatibility::label(found.subscription)
        );
        pairs.entry((&found.publisher.topic, found.reason())).or_default().insert(pair);
    }
    let bad = |((topic, reason), pairs): ((&str, String), BTreeSet<String>)| {
        let pairs = pairs.into_iter().collect::<Vec<_>>().join(", ");
        let fix = format!(
            "change one of them: `taut topic info {topic} -v` shows both; docs/qos.md lists what is compatible"
        );
        Finding::bad(format!("{topic}: no message gets from {pairs}: {reason}")).fix(fix)
    };
    pairs.into_iter().map(bad).collect()
}

/// The bytes that a file occupies in /dev/shm.
fn taken(path: &Path) -> u64 {
    fs::symlink_metadata(path).map_or(0, |file| file.blocks() * 512)
}

fn left_behind(domain: u32) -> Checked {
    let folder = shared_folder(domain);
    let list = |prefix: &str| shm::list(prefix).map_err(|error| error.to_string());
    let (mut left, mut traces, mut living) = (Vec::new(), Vec::new(), 0);
    for path in list(&format!("{folder}/"))? {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        // These two files have no owner; the last process removes them.
        if ["domain", "warden"].contains(&&*name) {
            continue;
        }
        let Ok(file) = PeerFile::open(path.clone(), false) else { continue };
        match file.is_owned() {
            true => living += 1,
            false if is_trace_file(&name) => traces.push(path),
            false => left.push(path),
        }
    }
    // Older versions left files without a folder.
    left.extend(list(&format!("{folder}_"))?);
    let bytes = |paths: &[PathBuf]| BinaryBytes(paths.iter().map(|path| taken(path)).sum());
    let path = Path::new(shm::DIRECTORY).join(&folder);
    let path = path.display();
    if left.is_empty() && traces.is_empty() {
        return Ok(Finding::good("nothing of processes that were killed"));
    }
    let value = format!(
        "of processes that were killed: {} files, {}, and {} traces, {}, in {path}",
        left.len(),
        bytes(&left),
        traces.len(),
        bytes(&traces)
    );
    let fix = match living {
        0 => format!("no process of the domain runs: rm -r {path}; `taut trace record --seconds 0` saves the traces before"),
        _ => "`taut trace record --seconds 0` fetches traces and removes them; the domain's processes remove the rest".to_owned(),
    };
    Ok(Finding::advice(value).fix(fix).script(
        // Only as a comment: processes may run again when the script is run.
        (living == 0).then(|| format!("# If no process of domain {domain} runs: rm -r '{path}'")),
    ))
}

/// Reports what is left of this user's other domains in which every process was killed, of all scopes; removes it if `remove` is set.
pub fn dead_domains(remove: bool) -> Checked {
    let folders = all_shared_folders().map_err(|error| format!("{}: {error}", shm::DIRECTORY))?;
    let (mut left, mut removed) = (Vec::new(), Vec::new());
    for (domain, folder) in folders {
        let files = shm::list(&format!("{folder}/")).map_err(|error| error.to_string())?;
        let scope = folder.split_once('.').map(|(_, scope)| format!(" of scope {scope}")).unwrap_or_default();
        let bytes = BinaryBytes(files.iter().map(|path| taken(path)).sum());
        let what = format!("domain {domain}{scope} ({} files, {bytes})", files.len());
        if remove && remove_dead_domain(&folder) {
            removed.push(what);
        } else if !remove && is_dead_domain(&folder) {
            left.push(what);
        }
    }
    if !left.is_empty() {
        let value = format!("every process was killed of {}", left.join(", "));
        return Ok(Finding::advice(value)
            .fix("taut doctor --remove-dead; the next program of this user that starts removes it, too")
            // Only as a comment: root, who runs the script, removes domains of root alone.
            .script(["# As the user whose domains they are: taut doctor --remove-dead"]));
    }
    Ok(Finding::good(match removed.is_empty() {
        true => "no domain of this user in which every process was killed".to_owned(),
        false => format!("removed: {}", removed.join(", ")),
    }))
}

/// Free memory in /dev/shm.
pub fn free_bytes(tree: &Tree) -> Result<u64, String> {
    let stat = rustix::fs::statvfs(tree.path(shm::DIRECTORY));
    let stat = stat.map_err(|errno| format!("{}: {}", shm::DIRECTORY, std::io::Error::from(errno).kind()))?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

fn memory(tree: &Tree, domain: u32) -> Checked {
    let files = shm::list(&format!("{}/", shared_folder(domain))).map_err(|error| error.to_string())?;
    let (free, taken) = (free_bytes(tree)?, files.iter().map(|path| taken(path)).sum::<u64>());
    let value = format!("{} free, domain {domain} has {}", BinaryBytes(free), BinaryBytes(taken));
    let least = BinaryBytes(LEAST_BYTES);
    let finding = match free {
        _ if free < LEAST_BYTES => {
            Finding::bad(format!("{value}: not enough for one more process ({least})"))
        }
        _ if free < taken => Finding::advice(format!("{value}: not enough to start as much again beside it")),
        _ => return Ok(Finding::good(value)),
    };
    Ok(finding
        .fix("mount -o remount,size=4G /dev/shm, in a container --shm-size; or lower depths and limits (docs/memory.md)")
        .script(["# As large as the topics need (docs/memory.md): mount -o remount,size=4G /dev/shm"]))
}
