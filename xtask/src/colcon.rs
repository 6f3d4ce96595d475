// SPDX-License-Identifier: MIT OR Apache-2.0
//! rmw_tautline as a package of a ROS 2 workspace: what colcon finds in this repository, builds and installs.

use crate::r2r::Environment;
use crate::steps::{Outcome, Steps, announce, execute};
use crate::{files, machine, packages, r2r, ros};
use std::path::Path;
use std::process::Command;

/// colcon-cargo, with which every crate may be a package.
const CARGO: &str =
    "colcon_core.package_identification.cargo:colcon_core.package_identification.cargo_workspace";

/// As a node and ROS's tools find it.
const INSTALLED: &str = "
import ctypes, os
from ament_index_python import get_resource
ctypes.CDLL('librmw_tautline.so').rmw_get_implementation_identifier
support, prefix = get_resource('rmw_typesupport', 'rmw_tautline')
assert prefix == os.path.join(os.getcwd(), 'install', 'rmw_tautline'), prefix
assert 'rosidl_typesupport_fastrtps_cpp' in support.split(';'), support
";

/// As bloom reads manifests.
const VALID: &str = "
import sys
from catkin_pkg.package import parse_package
warnings = []
for manifest in sys.argv[1:]:
    parse_package(manifest, warnings=warnings)
assert not warnings, warnings
";

/// With the library that the tests have built: cargo finds nothing to do.
pub fn test(steps: &mut Steps, environment: &Environment) {
    const NAME: &str = "rmw: colcon package";
    let has_wheels = environment.iter().any(|(name, _)| *name == r2r::RPATH);
    if !has_wheels && !machine::is_ci() && !packages::runs("colcon", &["--help"]) {
        return steps.skip(NAME, "sudo apt install python3-colcon-common-extensions");
    }
    let cmake = packages::prepare(&["cmake", "make"], || {
        if ["cmake", "make"].iter().all(|program| packages::runs(program, &["--version"])) {
            Ok(())
        } else {
            Err("cmake")
        }
    });
    if !matches!(cmake, Outcome::Ok) {
        steps.step(NAME, || cmake);
        return;
    }
    // A workspace of which this repository is the source.
    let workspace = ros::folder().join("colcon");
    let command = |program: &str| {
        let mut command = Command::new(program);
        command.current_dir(&workspace).envs(environment.clone());
        command.env("CARGO_TARGET_DIR", machine::target_dir());
        if has_wheels {
            let venv = ros::venv();
            command.env("PATH", machine::path_with("PATH", &venv.join("bin"))).env("VIRTUAL_ENV", venv);
        }
        command
    };
    steps.step(NAME, || check(&workspace, command));
}

fn check(workspace: &Path, command: impl Fn(&str) -> Command) -> Result<(), String> {
    files::make_empty(workspace).map_err(files::at(workspace))?;
    let source = ["--base-paths".into(), machine::root()];
    for without in ["", CARGO] {
        let mut list = command("colcon");
        list.args(["list", "--names-only"]).args(&source).env("COLCON_EXTENSION_BLOCKLIST", without);
        announce(&list);
        let output = list.output().map_err(|error| format!("colcon: {error}"))?;
        let found = String::from_utf8_lossy(&output.stdout);
        let mut found: Vec<&str> = found.lines().collect();
        found.sort_unstable();
        if found != ["rmw_tautline", "tautline_examples_rclcpp"] {
            return Err(format!("colcon finds {found:?} {}", String::from_utf8_lossy(&output.stderr)));
        }
    }
    let manifests = ["rmw", "examples/rclcpp"].map(|folder| machine::root().join(folder).join("package.xml"));
    execute(command("python3").args(["-c", VALID]).args(manifests))?;
    let colcon = |verb: &str| {
        let mut colcon = command("colcon");
        // Not the example, which needs rclcpp.
        colcon.arg(verb).arg("--base-paths").arg(machine::root().join("rmw"));
        colcon
    };
    let mut build = colcon("build");
    build.args(["--cmake-args", "-DCMAKE_BUILD_TYPE=Debug"]);
    execute(build.arg("-DRMW_TAUTLINE_CARGO_ARGS=--features xtask"))?;
    execute(colcon("test").arg("--return-code-on-test-failure"))?;
    let installed = format!(". install/setup.sh && exec python3 -c \"{INSTALLED}\"");
    execute(command("sh").args(["-c", &installed]))
}
