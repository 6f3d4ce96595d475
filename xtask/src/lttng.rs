// SPDX-License-Identifier: MIT OR Apache-2.0
//! LTTng for the test that records one run twice: its packages, installed where CI is set.

use crate::machine;
use crate::steps::{Outcome, Steps, cargo, execute};
use std::process::{Command, Stdio};

const PACKAGES: [&str; 3] = ["lttng-tools", "liblttng-ust-dev", "babeltrace2"];

/// The feature `lttng` has no warnings, and LTTng records what the rings record.
pub fn test(steps: &mut Steps) {
    const NAMES: [&str; 2] = ["lttng: clippy", "lttng: test"];
    let mut ready = false;
    steps.step("lttng: packages", || {
        let outcome = prepare();
        ready = matches!(outcome, Outcome::Ok);
        outcome
    });
    if !ready {
        return NAMES.iter().for_each(|name| steps.skip(name, "without its packages"));
    }
    let clippy = "clippy -p tautline-trace -p taut -p tautline-benches --features taut/lttng --all-targets -- -D warnings";
    steps.command(NAMES[0], &mut cargo(clippy));
    steps.command(NAMES[1], &mut cargo("test -p taut --features lttng --test lttng -- --nocapture"));
}

/// Installs what is missing, as root and where CI is set; on somebody's own machine that is for them to do.
fn prepare() -> Outcome {
    let Err(missing) = present() else { return Outcome::Ok };
    let line = format!("{missing} is missing: sudo apt install {}", PACKAGES.join(" "));
    if !machine::is_ci() {
        return Outcome::Skipped(line);
    }
    let apt = |arguments: &[&str]| {
        let mut command = Command::new("apt-get");
        command.args(arguments).env("DEBIAN_FRONTEND", "noninteractive");
        execute(&mut command)
    };
    let install = [&["install", "--yes", "--quiet", "--no-install-recommends"], &PACKAGES[..]].concat();
    if !matches!(apt(&install), Outcome::Ok) {
        // Its lists may be missing or old.
        apt(&["update", "--quiet"]);
        apt(&install);
    }
    match present() {
        Ok(()) => Outcome::Ok,
        Err(_) => Outcome::Failed(line),
    }
}

/// Whether everything is there; otherwise what is not.
fn present() -> Result<(), &'static str> {
    let runs = |program: &str, arguments: &[&str]| {
        let mut command = Command::new(program);
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        command.status().is_ok_and(|status| status.success())
    };
    for tool in ["lttng", "lttng-sessiond", "babeltrace2"] {
        if !runs(tool, &["--version"]) {
            return Err(tool);
        }
    }
    let header = ["-include", "lttng/tracepoint.h", "-x", "c", "-E", "/dev/null"];
    if runs("cc", &header) { Ok(()) } else { Err("lttng/tracepoint.h") }
}
