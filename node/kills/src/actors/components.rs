// SPDX-License-Identifier: MIT OR Apache-2.0
//! Containers, and processes that load components into them.

use super::actor::Actor;
use crate::Result;
use futures::executor::block_on;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Duration;
use tautline::composition_interfaces::srv::{LoadNode, UnloadNode};

const CONTAINER: &str = "taut-container";
const LIBRARY: &str = "libtautline_demo_components.so";
const COMPONENTS: [&str; 2] = ["demo::Counter", "demo::Doubler"];

/// The path of a file beside this program, where cargo puts it.
fn beside(name: &str) -> Result<PathBuf> {
    let path = std::env::current_exe()?.with_file_name(name);
    if path.exists() {
        return Ok(path);
    }
    let build = "cargo build --release -p tautline-kills -p tautline-container -p tautline-demo-components";
    Err(format!("{} is missing: {build}", path.display()).into())
}

/// Checks that the files that containers need exist.
pub fn check() -> Result<()> {
    [CONTAINER, LIBRARY].iter().try_for_each(|name| beside(name).map(drop))
}

pub fn contain() -> Result<()> {
    let library = beside(LIBRARY)?;
    let loads = COMPONENTS.map(|component| format!("{}:{component}", library.display()));
    let mut command = Command::new(beside(CONTAINER)?);
    Err(command.args(["--no-rt", "--namespace", "/actors"]).args(loads).stdout(Stdio::null()).exec().into())
}

/// Loads and unloads components of the containers that exist.
pub fn load(actor: &mut Actor) -> Result<()> {
    let _spinning = actor.spin();
    let library = beside(LIBRARY)?.display().to_string();
    let limit = Duration::from_millis(50);
    loop {
        let mut node = actor.node("loader")?;
        let load = node.create_client::<LoadNode::Service>("/ComponentManager/_container/load_node")?;
        let unload = node.create_client::<UnloadNode::Service>("/ComponentManager/_container/unload_node")?;
        for _ in 0..=actor.up_to(6) {
            let request = LoadNode::Request {
                package_name: library.clone(),
                plugin_name: actor.one_of(&COMPONENTS).into(),
                node_name: format!("loaded{}", actor.up_to(3)),
                node_namespace: "/actors".into(),
                ..Default::default()
            };
            if let Ok(response) = load.request_timeout(&request, limit)
                && let Ok(LoadNode::Response { success: true, unique_id, .. }) = block_on(response)
                && let Ok(response) = unload.request_timeout(&UnloadNode::Request { unique_id }, limit)
            {
                let _ = block_on(response);
            }
            actor.rest();
        }
    }
}
