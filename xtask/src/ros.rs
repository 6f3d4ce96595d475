// SPDX-License-Identifier: MIT OR Apache-2.0
//! A real ROS 2 from PyPI, in a Python environment under the target directory: rclpy, Fast DDS, message packages.

use crate::steps::execute;
use crate::{files, machine, word};
use clap::ValueEnum;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};

/// Those that PyPI has.
#[derive(Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum Distribution {
    #[default]
    Jazzy,
    Kilted,
}

static CHOSEN: Mutex<Distribution> = Mutex::new(Distribution::Jazzy);

/// From now on it is this one that is made, where none is sourced. Builds for another one take the place of those that are there.
pub fn choose(distribution: Distribution) {
    *CHOSEN.lock().unwrap_or_else(PoisonError::into_inner) = distribution;
}

pub fn chosen() -> Distribution {
    *CHOSEN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What it is in `ROS_DISTRO`.
pub fn distribution() -> String {
    word(chosen())
}

/// A step's name, with the distribution unless it is the usual one.
pub fn step(name: &str) -> String {
    match chosen() {
        Distribution::Jazzy => name.to_owned(),
        other => format!("{name}, {}", word(other)),
    }
}

/// Its packages, with the versions of Jazzy and Kilted.
const ROS: [(&str, [&str; 2]); 10] = [
    ("rclpy", ["7.1.6", "9.1.2"]),
    ("rmw-fastrtps-cpp", ["8.4.3", "9.3.3"]),
    ("common-interfaces", ["5.3.6", "5.5.1"]),
    ("std-msgs", ["5.3.6", "5.5.1"]),
    ("std-srvs", ["5.3.6", "5.5.1"]),
    ("lifecycle-msgs", ["2.0.3", "2.3.0"]),
    ("test-msgs", ["2.0.3", "2.3.0"]),
    // To build rmw_tautline as a package of a ROS 2 workspace.
    ("ament-cmake", ["2.5.4", "2.7.3"]),
    ("ament-cmake-include-directories", ["2.5.4", "2.7.3"]),
    ("ament-package", ["0.16.4", "0.17.2"]),
];

const OTHERS: [&str; 8] = [
    "colcon-core==0.21.3",
    "colcon-ros==0.5.0",
    "colcon-package-information==0.4.1",
    "colcon-cargo==0.2.0",
    // Not ROS's: what the bridge asks Cyclone DDS is asked of it in a test.
    "cyclonedds==11.0.1",
    // Nor these: they read what `taut record` writes.
    "rosbags==0.11.9",
    "mcap==1.6.0",
    "mcap-ros2-support==0.6.0",
];

/// The folder of all that is of a distribution. Tests look for it by this name.
pub fn folder_of(distribution: Distribution) -> PathBuf {
    machine::target_dir().join(match distribution {
        Distribution::Jazzy => "ros",
        Distribution::Kilted => "ros-kilted",
    })
}

/// That of the chosen one.
pub fn folder() -> PathBuf {
    folder_of(chosen())
}

/// The environment.
pub fn venv() -> PathBuf {
    folder().join("venv")
}

/// Makes the environment unless it is there already. Ten seconds and 120 MB from PyPI.
pub fn prepare() -> Result<(), String> {
    let ros = wheels();
    let wheels: Vec<&str> = ros.iter().map(String::as_str).chain(OTHERS).collect();
    make_venv(&venv(), &wheels, python)
}

/// The chosen one's own packages, each with its version.
pub fn wheels() -> [String; ROS.len()] {
    let (distribution, of) = (distribution(), chosen() as usize);
    ROS.map(|(name, versions)| format!("ros-{distribution}-{name}=={}", versions[of]))
}

/// Makes a Python environment with packages from PyPI unless it is there already.
pub fn make_venv(
    venv: &Path,
    wheels: &[&str],
    python: impl FnOnce() -> Result<String, String>,
) -> Result<(), String> {
    let say = files::at(venv);
    // Written last: what was interrupted is made anew.
    let (complete, names) = (venv.join("wheels.txt"), wheels.join("\n"));
    if fs::read_to_string(&complete).is_ok_and(|there| there == names) {
        return Ok(());
    }
    let python = python()?;
    files::remove(venv).map_err(say)?;
    // The wheels' packages are none of a workspace that this repository is in.
    files::write(&machine::target_dir().join("COLCON_IGNORE"), "")?;
    let made = execute(Command::new(&python).args(["-m", "venv"]).arg(venv));
    made.map_err(|reason| format!("{python} -m venv: {reason}"))?;
    let mut install = Command::new(venv.join("bin/pip"));
    install.args(["install", "--quiet", "--disable-pip-version-check"]).args(wheels);
    execute(&mut install)?;
    fs::write(complete, names).map_err(say)
}

/// A Python of a version that the wheels are built for; of CI's, if it is there.
pub fn python() -> Result<String, String> {
    let fits = |python: &str| {
        let mut command = Command::new(python);
        command.args(["-c", "import sys, venv; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))"]);
        command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
    };
    let python = ["python3.11", "python3"].into_iter().find(|python| fits(python)).map(str::to_owned);
    python.ok_or("the wheels need Python 3.10 to 3.13 with its venv module: install python3-venv".to_owned())
}
