// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node that is announced for endpoints without a node.

use tautline_transport::NodeName;

/// A node named after the process, for endpoints without a node.
pub fn process_node(pid: Option<u32>) -> NodeName {
    let node = |name: String| NodeName { namespace: "/".into(), name };
    let name = pid.and_then(|pid| Some((pid, std::fs::read_to_string(format!("/proc/{pid}/comm")).ok()?)));
    let Some((pid, name)) = name else { return node("unnamed".into()) };
    let mut name: String =
        name.trim().chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    if !name.starts_with(|first: char| first.is_ascii_alphabetic()) {
        name.insert_str(0, "process_");
    }
    node(format!("{name}_{pid}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processes_have_names_that_nodes_can_have() {
        let me = process_node(Some(std::process::id()));
        assert!(me.name.ends_with(&std::process::id().to_string()) && me.namespace == "/", "{me:?}");
        assert!(me.is_valid());
        assert_eq!(process_node(None), process_node(Some(u32::MAX)));
    }
}
