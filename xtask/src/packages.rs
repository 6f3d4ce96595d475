// SPDX-License-Identifier: MIT OR Apache-2.0
//! Debian's packages that some tests need.

use crate::machine;
use crate::steps::{Outcome, execute};
use std::process::{Command, Stdio};

/// Installs what is missing, as root and where CI is set; on somebody's own machine that is for them to do. `present` says what is
/// not there.
pub fn prepare(packages: &[&str], present: impl Fn() -> Result<(), &'static str>) -> Outcome {
    let Err(missing) = present() else { return Outcome::Ok };
    let line = format!("{missing} is missing: sudo apt install {}", packages.join(" "));
    if !machine::is_ci() {
        return Outcome::Skipped(line);
    }
    let apt = |arguments: &[&str]| {
        let mut command = Command::new("apt-get");
        command.args(arguments).env("DEBIAN_FRONTEND", "noninteractive");
        execute(&mut command)
    };
    let install = [&["install", "--yes", "--quiet", "--no-install-recommends"], packages].concat();
    if apt(&install).is_err() {
        // Its lists may be missing or old.
        let _ = apt(&["update", "--quiet"]);
        let _ = apt(&install);
    }
    present().map_err(|_| line).into()
}

/// Whether a program is there and content with its arguments.
pub fn runs(program: &str, arguments: &[&str]) -> bool {
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// What drops packets for the gateway's tests.
pub fn firewall() -> Outcome {
    let is_there = || ["nft", "iptables"].iter().any(|program| runs(program, &["--version"]));
    prepare(&["nftables"], || if is_there() { Ok(()) } else { Err("nft") })
}
