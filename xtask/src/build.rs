// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which build of a program is run: the release build, whose figures count, or that of the tests, which is there already.

use crate::machine;
use crate::steps::execute;
use std::path::PathBuf;
use std::process::Command;

/// A build of the workspace's programs.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
pub enum Build {
    /// Made when it is needed.
    #[default]
    Release,
    /// Made by [`crate::lints::build`] before.
    Tests,
}

/// Every package with every bundled message: what has other features is built anew, with all that needs it.
pub const WHOLE: &str = "--workspace --features tautline-r2r/ros_all,tautline/type_description_interfaces";

/// All targets but benches, of which there are none: for them, `--all-targets` would build libraries without unit tests once more, as tests.
pub const TARGETS: &str = "--lib --bins --tests --examples";

/// What `cargo xtask test` leaves to `cargo xtask ci`: Zenoh takes minutes to build.
pub const LATER: [&str; 1] = ["tautline-gateway"];

/// What is tested with the gateway, in nextest's words.
pub const WITH_GATEWAY: &str = "package(tautline-gateway)|(package(taut)&binary(hops))";

/// What is compared with a ROS 2.
pub const WITH_ROS: &str =
    "binary(ros_hashes)|binary(ros_values)|test(ros::)|test(others_read)|test(recorded_as_events)";

/// Packages that ask for the features that all of [`WHOLE`] has of other packages: what is built with them and some package of ours shares
/// these with [`WHOLE`].
pub const SAME: &str = "-p xtask-features -p xtask-host-features";

/// [`WHOLE`] with more features, with commas between.
pub fn whole_with(features: &str) -> String {
    format!("{WHOLE} --features {features}")
}

/// [`WHOLE`] without [`LATER`]. What both build is the same, for `xtask-features` asks for the same features of other packages as what is left
/// out; [`crate::shared`] checks it.
pub fn most() -> String {
    LATER.iter().fold(WHOLE.to_owned(), |most, package| most + " --exclude " + package)
}

/// Builds; what is to be run later is then there.
pub fn build(command: &mut Command) -> Result<(), String> {
    execute(command).map_err(|reason| format!("the build failed: {reason}"))
}

impl Build {
    /// Has this command build for a release; what it builds is there for the tests. Says where.
    pub fn with(self, command: &mut Command) -> Result<PathBuf, String> {
        if self == Build::Release {
            build(command)?;
        }
        Ok(self.folder())
    }

    /// Where its programs are.
    pub fn folder(self) -> PathBuf {
        machine::target_dir().join(match self {
            Build::Release => "release",
            Build::Tests => "debug",
        })
    }
}
