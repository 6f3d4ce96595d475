// SPDX-License-Identifier: MIT OR Apache-2.0
//! What dead processes left of their iceoryx2 nodes.

use crate::graph::Graph;
use crate::topic::IoxNode;
use iceoryx2::node::{NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, Config, Node as Iceoryx2Node, ipc};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::{fs, io};

/// The mode of iceoryx2's files until they are written.
const INCOMPLETE: u32 = 0o600;

/// Removes it, and says so to those who wait for changes.
pub(crate) fn remove(node: &IoxNode, graph: &Graph) {
    // Counts nodes without details as removed, every time.
    let removed = node.try_cleanup_dead_nodes().cleanups;
    if removed == 0 {
        return;
    }
    let nameless = without_details(node.config());
    if removed > nameless.len() as u64 || complete(node, &nameless) {
        graph.advance();
    }
}

/// Gives the nodes the details that they lack, takes what stands in the way, and removes them. Returns whether any was removed.
///
/// iceoryx2 looks for the rest of a dead node where the configuration says that was kept with it. Of a process that was killed
/// before it had written that, everything else would stay for ever; and of one that was killed while it made a port, for a
/// tag that is not complete is never removed, but the details are. All nodes of a domain have one configuration: ours.
fn complete(node: &IoxNode, nameless: &[u128]) -> bool {
    let config = node.config();
    let own = details(config, node.id().value());
    let prepare = |id: &u128| -> io::Result<()> {
        let path = details(config, *id);
        remove_incomplete(path.parent().unwrap_or(&path))?;
        let draft = path.with_extension(format!("{}", std::process::id()));
        fs::copy(&own, &draft)?;
        fs::rename(&draft, path)
    };
    // Where that fails somebody else has removed it, or it is tried again at the next look.
    nameless.iter().filter(|id| prepare(id).is_ok()).count() > 0 && node.try_cleanup_dead_nodes().cleanups > 0
}

/// Removes the files of a dead node that are as their maker left them when it was killed: nobody has read them.
fn remove_incomplete(folder: &Path) -> io::Result<()> {
    for file in fs::read_dir(folder)? {
        let file = file?;
        if file.metadata()?.permissions().mode() & 0o777 == INCOMPLETE {
            fs::remove_file(file.path())?;
        }
    }
    Ok(())
}

/// The dead nodes of which nobody can say how they were configured.
fn without_details(config: &Config) -> Vec<u128> {
    let mut found = Vec::new();
    // What cannot be listed is not removed either.
    let _ = Iceoryx2Node::<ipc::Service>::list(config, |state| {
        if let NodeState::Dead(dead) = state
            && dead.details().is_none()
        {
            found.push(dead.id().value());
        }
        CallbackProgression::Continue
    });
    found
}

/// The file of a node's details, as iceoryx2 names it.
fn details(config: &Config, id: u128) -> PathBuf {
    let global = &config.global;
    let folder = Path::new(&global.node_dir().to_string()).join(id.to_string());
    folder.join(format!("{}node{}", global.prefix, global.node.static_config_suffix))
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::participant::open_node;

    #[test]
    fn a_node_without_details_is_removed_and_told_of_once() {
        const DOMAIN: u32 = 97;
        // One run at a time: another's would remove this one's.
        let lock = format!("taut_test_{}_domain_{DOMAIN}.lock", rustix::process::getuid().as_raw());
        let lock = fs::File::create(std::env::temp_dir().join(lock)).unwrap();
        rustix::fs::flock(&lock, rustix::fs::FlockOperation::LockExclusive).unwrap();
        // No participant, whose janitor would look too.
        let node = open_node(DOMAIN).unwrap();
        let graph = Graph::open(DOMAIN).unwrap();
        remove(&node, &graph);
        let config = node.config();
        // As of a process that was killed: files that nobody has locked.
        let id = node.id().value() + 1;
        let folder = details(config, id).parent().unwrap().to_owned();
        let nodes = folder.parent().unwrap().to_owned();
        let monitor = |end: &str| nodes.join(format!("{}{id}.node_monitor{end}", config.global.prefix));
        fs::create_dir(&folder).unwrap();
        let tag = folder.join(format!("{}1234.port_tag", config.global.prefix));
        fs::write(&tag, "").unwrap();
        fs::set_permissions(tag, fs::Permissions::from_mode(INCOMPLETE)).unwrap();
        let own = format!("{}{}.node_monitor_context", config.global.prefix, id - 1);
        let mut context = fs::read(nodes.join(own)).unwrap();
        // Starts with the number of the process: one that nobody has.
        context[..4].copy_from_slice(&(i32::MAX - 1).to_le_bytes());
        fs::write(monitor("_context"), context).unwrap();
        fs::write(monitor("_owner_lock"), "").unwrap();
        fs::write(monitor(""), "").unwrap();
        assert_eq!(without_details(config), [id]);

        let before = graph.epoch();
        remove(&node, &graph);
        assert!(!folder.exists() && !monitor("").exists() && without_details(config).is_empty());
        assert_eq!(graph.epoch(), before + 1, "its end is one change");
        remove(&node, &graph);
        assert_eq!(graph.epoch(), before + 1, "and no other");
    }
}
