// SPDX-License-Identifier: MIT OR Apache-2.0
//! A guest while it runs, and what it says.

use crate::debian::{self, Architecture};
use crate::files;
use crate::running::Running;
use std::cell::RefCell;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

/// Far longer than any of them takes.
const PATIENCE: Duration = Duration::from_secs(45 * 60);

/// What a guest has said.
#[derive(Default)]
pub struct Report {
    /// Executables of tests, examples and others.
    programs: usize,
    passed: usize,
    /// Tests that have failed once and then passed.
    flaky: usize,
    failed: usize,
    has_ended: bool,
    /// How much was heard.
    len: usize,
    took: Duration,
}

/// Boots a guest, and shows what it says until it ends. A kernel that panics before it has started any program is booted once more: an
/// emulator of several threads may run code while the kernel patches it, early at each boot, which says nothing of what is tested.
pub fn run(name: &str, of: Architecture, kernel: &Path, image: &Path) -> Result<Report, String> {
    let (mut report, mut end) = boot(name, of, kernel, image)?;
    if !report.has_ended && report.programs == 0 && end.contains("Kernel panic") {
        println!("{name}: booted once more: {end}");
        (report, end) = boot(name, of, kernel, image)?;
    }
    if report.has_ended { Ok(report) } else { Err(format!("it did not come to an end {end}")) }
}

/// Boots it once. Also returns how that ended, in words for an error.
fn boot(name: &str, of: Architecture, kernel: &Path, image: &Path) -> Result<(Report, String), String> {
    let (machine, console): (&[&str], _) = match of {
        Architecture::Amd64 => (&["-cpu", "max", "-m", "6144"], "console=ttyS0 tsc=reliable"),
        Architecture::Arm64 => {
            (&["-M", "virt,gic-version=3", "-cpu", "max,pauth-impdef=on", "-m", "6144"], "console=ttyAMA0")
        }
        Architecture::Riscv64 => (&["-M", "virt", "-cpu", "rv64", "-m", "6144"], "console=ttyS0"),
    };
    let mut command = Command::new(of.emulator()[0]);
    // Emulated even where the processor could run it: a hypervisor in another is often slow, or hangs.
    command.args(["-accel", "tcg,thread=multi", "-smp", "2", "-no-reboot", "-nodefaults"]).args(machine);
    command.args(["-display", "none", "-serial", "stdio", "-append"]);
    command.arg(format!("{console} loglevel=1 panic=-1"));
    command.arg("-kernel").arg(kernel).arg("-initrd").arg(image);
    let start = Instant::now();
    let mut guest = Running::start(&mut command, true)?;
    let report = RefCell::new(Report::default());
    let status = guest.wait_until(start + PATIENCE, |said| report.borrow_mut().hear_more(name, said));
    guest.end();
    let said = guest.said();
    let mut report = report.into_inner();
    report.took = start.elapsed();
    let log = debian::folder().join(format!("{name}.log"));
    files::write(&log, &said)?;
    let last = said.lines().rev().take(5).collect::<Vec<_>>().join(" | ");
    let ended =
        status.map_or_else(|| format!("not within {} s", PATIENCE.as_secs()), |status| status.to_string());
    Ok((report, format!("({ended}); all that it said is in {}, lastly: {last}", log.display())))
}

impl Report {
    /// Takes the whole lines that are new, and says whether the last has come.
    fn hear_more(&mut self, guest: &str, said: &str) -> bool {
        let new = &said[self.len..];
        let whole = new.rfind('\n').map_or(0, |end| end + 1);
        self.len += whole;
        new[..whole].lines().for_each(|line| self.hear(guest, line.trim_end()));
        self.has_ended
    }

    fn hear(&mut self, guest: &str, line: &str) {
        let Some((kind, text)) =
            line.strip_prefix('@').map(|line| line.split_once(' ').unwrap_or((line, "")))
        else {
            return;
        };
        match kind {
            "pass" => self.passed += 1,
            "flaky" => (self.passed, self.flaky) = (self.passed + 1, self.flaky + 1),
            "fail" => self.failed += 1,
            "begin" => self.programs += 1,
            "end" => self.has_ended = true,
            _ => {}
        }
        match kind {
            "pass" | "end" => {}
            "begin" | "guest" => println!("{guest}: {text}"),
            "said" => println!("    {text}"),
            _ => println!("{guest}: {}: {text}", kind.to_uppercase()),
        }
    }

    pub fn verdict(&self) -> Result<(), String> {
        match (self.passed, self.failed) {
            (0, _) => Err("no test passed".to_owned()),
            (_, 0) => Ok(()),
            (passed, failed) => Err(format!("{failed} of {} tests failed", passed + failed)),
        }
    }
}

/// A line for each guest.
pub fn print(reports: &[(String, Report)]) {
    println!(
        "\n{:<10} {:>8} {:>7} {:>6} {:>7} {:>8}",
        "guest", "programs", "passed", "flaky", "failed", "seconds"
    );
    for (guest, report) in reports {
        let Report { programs, passed, flaky, failed, took, .. } = report;
        println!("{guest:<10} {programs:>8} {passed:>7} {flaky:>6} {failed:>7} {:>8.0}", took.as_secs_f64());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_guest_says_is_counted_by_whole_lines() {
        let mut report = Report::default();
        let said = "firmware\r\n@begin rt\r\n@pass rt a\r\n@flaky rt b\r\n@said why\r\n@fail rt c: exit code 1\r\n@e";
        assert!(!report.hear_more("x", said));
        assert_eq!((report.programs, report.passed, report.flaky, report.failed), (1, 2, 1, 1));
        assert_eq!(report.verdict(), Err("1 of 3 tests failed".to_owned()));
        assert!(report.hear_more("x", &format!("{said}nd\r\n")));
        assert_eq!(report.passed, 2, "what was heard is not counted again");
        assert!(Report::default().verdict().is_err());
    }
}
