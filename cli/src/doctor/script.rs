// SPDX-License-Identifier: MIT OR Apache-2.0
//! `--fix-script`: the fixes as a script to read, change and run. Nothing runs it here.

use super::finding::{Finding, Verdict, plain};
use std::io::{self, Write};

const HEAD: &str = "#!/bin/sh
# Printed by `taut doctor --fix-script`. Read it, strike out what you do not want, then run it as root.
# What it writes to /proc and /sys lasts until the next boot.
if [ \"$(id -u)\" != 0 ]; then
    echo 'run this as root, after reading it' >&2
    exit 1
fi
";

pub fn write(findings: &[Finding], out: &mut impl Write) -> io::Result<()> {
    out.write_all(HEAD.as_bytes())?;
    for finding in findings.iter().filter(|finding| finding.verdict != Verdict::Good) {
        writeln!(out, "\n# {}, {}: {}", finding.check, finding.verdict.as_str(), plain(&finding.value))?;
        if let Some(cost) = finding.cost_text() {
            writeln!(out, "# cost: {}", plain(&cost))?;
        }
        if finding.script.is_empty() {
            writeln!(out, "# fix by hand: {}", plain(&finding.fix))?;
        }
        finding.script.iter().try_for_each(|line| writeln!(out, "{line}"))?;
    }
    Ok(())
}
