// SPDX-License-Identifier: MIT OR Apache-2.0
//! LTTng for the test that records one run twice: its packages, installed where CI is set.

use crate::packages;
use crate::steps::{Outcome, Steps, cargo};

const PACKAGES: [&str; 3] = ["lttng-tools", "liblttng-ust-dev", "babeltrace2"];

/// The feature `lttng` has no warnings, and LTTng records what the rings record.
pub fn test(steps: &mut Steps) {
    const NAMES: [&str; 2] = ["lttng: clippy", "lttng: test"];
    let mut ready = false;
    steps.step("lttng: packages", || {
        let outcome = packages::prepare(&PACKAGES, present);
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

/// Whether everything is there; otherwise what is not.
fn present() -> Result<(), &'static str> {
    for tool in ["lttng", "lttng-sessiond", "babeltrace2"] {
        if !packages::runs(tool, &["--version"]) {
            return Err(tool);
        }
    }
    let header = ["-include", "lttng/tracepoint.h", "-x", "c", "-E", "/dev/null"];
    if packages::runs("cc", &header) { Ok(()) } else { Err("lttng/tracepoint.h") }
}
