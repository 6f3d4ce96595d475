// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bridge-ros`: becomes `taut-bridge-ros`, a program of its own, so that nobody needs a ROS 2 who does not use it.

use crate::sibling::{Sibling, SiblingError};
use clap::Args;
use std::ffi::OsString;
use std::process::{Command, ExitCode, Stdio};

const BRIDGE: Sibling = Sibling {
    program: "taut-bridge-ros",
    build: "it needs a ROS 2: source one (source /opt/ros/jazzy/setup.bash, or what `cargo xtask ros` says), then build it with \
            `cargo build --release --manifest-path bridge-ros/Cargo.toml --target-dir target`, or install it with \
            `cargo install --path bridge-ros`",
};

/// Joins Tautline's topics with those of a ROS 2 graph, of any RMW.
///
/// Runs the program taut-bridge-ros: the one beside this one, else the one in PATH. Its options: taut bridge-ros --help.
#[derive(Args, Debug)]
#[command(disable_help_flag = true)]
pub struct BridgeRosArgs {
    /// Passed on
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "OPTIONS")]
    arguments: Vec<OsString>,
}

/// Why the bridge was not started.
#[derive(Debug, thiserror::Error)]
pub enum BridgeRosError {
    #[error(transparent)]
    Start(#[from] SiblingError),
    #[error(
        "taut-bridge-ros needs libraries of ROS 2 that are not found ({}): source the ROS 2 that it was built with \
         (source /opt/ros/jazzy/setup.bash), and run it again", missing.join(", ")
    )]
    Libraries { missing: Vec<String> },
}

/// Does not return if the bridge could be started.
pub fn run(args: BridgeRosArgs) -> Result<ExitCode, BridgeRosError> {
    let program = BRIDGE.path();
    // What the loader would say is no help to somebody who has not sourced ROS 2: it is asked first.
    let mut ask = Command::new(&program);
    let answer = ask.env("LD_TRACE_LOADED_OBJECTS", "1").stdin(Stdio::null()).output();
    let answer = answer.map_err(|source| BRIDGE.error(program, source))?;
    let missing = missing_libraries(&String::from_utf8_lossy(&answer.stdout));
    if !missing.is_empty() {
        return Err(BridgeRosError::Libraries { missing });
    }
    Err(BRIDGE.become_it(&args.arguments).into())
}

/// Of lines such as `librcl.so => not found`.
fn missing_libraries(text: &str) -> Vec<String> {
    let name = |line: &str| Some(line.split_once(" => not found")?.0.trim().to_owned());
    let mut missing: Vec<String> = text.lines().filter_map(name).collect();
    missing.sort();
    missing.dedup();
    missing
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loader_says_what_is_missing() {
        let text = "\tlinux-vdso.so.1 (0x7f)\n\tlibrcl.so => not found\n\tlibc.so.6 => /lib/libc.so.6 (0x7f)\n\tlibrcl.so => not found\n";
        assert_eq!(missing_libraries(text), ["librcl.so"]);
        assert!(missing_libraries("").is_empty());
    }
}
