// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bridge-ros`: runs `taut-bridge-ros`, a separate program, so that only its users need ROS 2.

use crate::sibling::Sibling;
use crate::verb::{Failure, Outcome};
use clap::Args;
use std::ffi::OsString;
use std::process::{Command, ExitCode, Stdio};
use tautline_rt::host::with_former_open_files;

pub const BRIDGE: Sibling = Sibling {
    program: "taut-bridge-ros",
    build: "it needs a ROS 2: source one (source /opt/ros/jazzy/setup.bash, or what `cargo xtask ros` says), then build it with \
            `cargo build --release --manifest-path bridge-ros/Cargo.toml --target-dir target`, or install it with \
            `cargo install --locked --path bridge-ros`",
};

/// Joins Tautline's topics with those of a ROS 2 graph.
///
/// Runs the program taut-bridge-ros, from the folder of this program or from PATH. Its options: taut bridge-ros --help.
#[derive(Args, Debug)]
#[command(disable_help_flag = true)]
pub struct BridgeRosArgs {
    /// The bridge's options
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "OPTIONS")]
    arguments: Vec<OsString>,
}

/// Returns only if the bridge cannot be started.
pub fn run(args: BridgeRosArgs) -> Outcome<ExitCode> {
    // The loader or ROS may end the program before it prints an error, so this checks first whether it can run.
    let program = BRIDGE.path();
    let mut command = Command::new(&program);
    let answer = with_former_open_files(command.arg("--version")).stdin(Stdio::null()).output();
    let answer = answer.map_err(|source| BRIDGE.error(&program, &source))?;
    if !answer.status.success() {
        let rmw = std::env::var("RMW_IMPLEMENTATION").ok().filter(|value| !value.is_empty());
        return Err(Failure::unusable(explained(&String::from_utf8_lossy(&answer.stderr), rmw)));
    }
    Err(BRIDGE.become_it(&args.arguments))
}

fn explained(stderr: &str, rmw: Option<String>) -> String {
    let said = stderr.trim().lines().next().unwrap_or("it says nothing");
    match rmw {
        _ if stderr.contains("shared librar") && !stderr.contains("rmw") => format!(
            "taut-bridge-ros does not find the libraries of ROS 2: {said}; source the ROS 2 that it was built with \
             (source /opt/ros/jazzy/setup.bash), and run it again"
        ),
        Some(value) => format!(
            "ROS 2 does not start with RMW_IMPLEMENTATION={value}: {said}; unset it, or install that one (apt install \
             ros-$ROS_DISTRO-{}) and source ROS 2 again",
            value.replace('_', "-")
        ),
        None => format!("taut-bridge-ros does not start: {said}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_loader_and_ros_say_is_explained() {
        let loader = "taut-bridge-ros: error while loading shared libraries: librcl.so: cannot open shared object file\n";
        let said = explained(loader, None);
        assert!(said.contains("librcl.so") && said.contains("source /opt/ros/jazzy/setup.bash"), "{said}");
        let rcl = "[ERROR] [rcl]: Expected RMW implementation identifier of 'rmw_x_cpp' but instead found 'rmw_fastrtps_cpp'\n";
        let said = explained(rcl, Some("rmw_x_cpp".into()));
        assert!(
            said.contains("RMW_IMPLEMENTATION=rmw_x_cpp: ") && said.contains("ros-$ROS_DISTRO-rmw-x-cpp"),
            "{said}"
        );
        assert!(explained("", None).contains("it says nothing"));
    }
}
