// SPDX-License-Identifier: MIT OR Apache-2.0
//! LTTng for the test that records one run twice: its packages, installed where CI is set.

use crate::build::whole_with;
use crate::steps::{Outcome, Steps};
use crate::{lints, packages};

const PACKAGES: [&str; 3] = ["lttng-tools", "liblttng-ust-dev", "babeltrace2"];

/// The packages that [`test()`] needs.
pub fn prepare() -> Outcome {
    packages::prepare(&PACKAGES, present)
}

/// The feature `lttng` has no warnings, and LTTng records what the rings record.
pub fn test(steps: &mut Steps) {
    const NAMES: [&str; 2] = ["lttng: build and lints", "lttng: test"];
    if present().is_err() {
        return NAMES.iter().for_each(|name| steps.skip(name, "without its packages"));
    }
    // Of all packages, for what does not depend on the feature has been built so.
    let test = whole_with("taut/lttng") + " --test lttng";
    lints::build(steps, NAMES[0], &format!("{test} --bin taut"));
    steps.command(NAMES[1], &mut lints::cargo(&format!("test {test} -- --nocapture")));
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
