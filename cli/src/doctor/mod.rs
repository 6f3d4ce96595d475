// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut doctor`: whether this host, and what runs on it, is fit for real time.

mod cores;
mod domain;
mod finding;
mod host;
mod kernel;
mod measure;
mod memory;
mod rights;
mod script;
mod system;

use crate::verb::{CommonArgs, End, Failure, Outcome, time};
use clap::Args;
use finding::{Checked, Finding, Verdict, is_fit};
use host::{Host, Tree};
use serde_json::{Value, json};
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;
use system::System;
use tautline::CoreSet;

/// Checks whether this host is fit for real time, and finds faults in a domain
///
/// For each finding it prints the measured value, the cost for a real-time thread, and the fix. "bad": no bound holds, or something
/// is refused or lost. "unknown": the value could not be read, which counts as a failure. "advice": it costs time. Changes nothing, except with
/// --remove-dead.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut doctor
  taut doctor --cores 2-3               for real-time threads on these cores
  taut doctor --measure 10              measure the interruptions of each core, 10 s each
  taut doctor --system robot.toml       does the file fit this host?
  taut doctor --fix-script > fix.sh     to read, change and run
  taut doctor --json | jq '.findings[] | select(.verdict == \"bad\")'

Exit codes: 0 all is well, 1 something is bad or unknown, 2 the arguments cannot be used.")]
pub struct DoctorArgs {
    /// The cores of real-time threads, such as 2-3,5 [default: those of the system file, else isolated ones, else all]
    #[arg(long, value_name = "LIST", value_parser = cores)]
    cores: Option<CoreSet>,
    /// Spin for this time on each of these cores in turn, at the highest required priority, and report the interruptions
    #[arg(long, value_name = "TIME", value_parser = time)]
    measure: Option<Duration>,
    /// Check that a system file fits this host; if the file has several hosts, TAUT_HOST names this one
    #[arg(long, value_name = "FILE")]
    system: Option<PathBuf>,
    /// Remove what is left of this user's domains in which every process was killed
    #[arg(long)]
    remove_dead: bool,
    /// Print a shell script of the fixes instead; the script is not run
    #[arg(long, conflicts_with = "json")]
    fix_script: bool,
    /// Read /proc, /sys, /etc, /run and /dev below this folder
    #[arg(long, value_name = "DIR", default_value = "/", hide = true)]
    root: PathBuf,
    #[command(flatten)]
    common: CommonArgs,
}

fn cores(list: &str) -> Result<CoreSet, String> {
    CoreSet::parse(list).filter(|cores| !cores.is_empty()).ok_or("a list of cores is 2-3,5".into())
}

/// The sampler's priority, unless the system file states a higher one.
const PRIORITY: u8 = 90;

type Check = (&'static str, fn(&Host) -> Checked);

/// The checks of every host.
const CHECKS: [Check; 17] = [
    ("preemption", kernel::preemption),
    ("throttling", kernel::throttling),
    ("fair server", kernel::fair_server),
    ("priority", rights::priority),
    ("locked memory", rights::locked_memory),
    ("cgroup", rights::cgroup),
    ("cores", cores::online),
    ("isolation", cores::isolation),
    ("interrupts", cores::interrupts),
    ("governor", cores::governor),
    ("idle states", cores::idle),
    ("siblings", cores::siblings),
    ("clock", kernel::clock),
    ("swap", memory::swap),
    ("huge pages", memory::huge_pages),
    ("steal", kernel::steal),
    ("logout", rights::remove_ipc),
];

/// Runs the verb; the exit code is the verdict.
pub fn run(args: &DoctorArgs) -> Outcome<ExitCode> {
    let end = End::of(&args.common)?;
    let domain = args.common.domain()?;
    let system = args.system.as_deref().map(System::read).transpose()?;
    let named = args.cores.or(system.as_ref().map(System::cores));
    let priority = system.as_ref().map_or(PRIORITY, System::priority);
    let host = Host::new(Tree::new(args.root.clone()), named, priority);
    if args.measure.is_some() && !host.tree.is_here() {
        return Err(Failure::unusable("--measure watches this host, not the files of another one"));
    }

    let mut findings: Vec<Finding> =
        CHECKS.iter().map(|(name, check)| Finding::of(name, check(&host))).collect();
    if host.tree.is_here() {
        findings.push(Finding::of("budgets", kernel::budgets(&host)));
        findings.push(Finding::of("dead domains", domain::dead_domains(args.remove_dead)));
    }
    findings.extend(system.iter().flat_map(|system| system.findings(&host)));
    findings.extend(domain::findings(&host.tree, domain));
    let mut seen = Vec::new();
    if let Some(window) = args.measure {
        let cores = host.cores().map_err(Failure::unusable)?;
        seen = measure::watch(cores, window, priority, &end)?;
        findings.push(Finding::of("interruptions", measure::finding(&seen)));
    }
    findings.sort_by_key(|finding| finding.verdict);

    let is_fit = is_fit(&findings);
    let mut out = crate::print::stdout();
    if args.fix_script {
        script::write(&findings, &mut out)?;
        out.flush()?;
        return Ok(ExitCode::SUCCESS);
    }
    if args.common.json {
        let all = json!({
            "fit": is_fit, "domain": domain, "cores": host.cores().ok().map(|cores| cores.to_string()),
            "findings": Value::from_iter(findings.iter().map(Finding::to_json)),
            "interruptions": Value::from_iter(seen.iter().map(measure::Seen::to_json)),
        });
        writeln!(out, "{all}")?;
    } else {
        findings.iter().try_for_each(|finding| finding.write(&mut out))?;
        if !seen.is_empty() {
            writeln!(out)?;
            measure::write(&seen, &mut out)?;
        }
        writeln!(out, "\n{}", summary(&findings, is_fit))?;
    }
    out.flush()?;
    Ok(if is_fit { ExitCode::SUCCESS } else { ExitCode::from(1) })
}

fn summary(findings: &[Finding], is_fit: bool) -> String {
    let count = |verdict: Verdict| findings.iter().filter(|finding| finding.verdict == verdict).count();
    let counts = [Verdict::Bad, Verdict::Unknown, Verdict::Advice, Verdict::Good]
        .map(|verdict| format!("{} {}", count(verdict), verdict.as_str()));
    let verdict = if is_fit { "Fit for real time" } else { "Not fit for real time" };
    let script = if count(Verdict::Good) == findings.len() {
        ""
    } else {
        " `taut doctor --fix-script` prints the fixes as a script."
    };
    format!("{verdict}: {}.{script}", counts.join(", "))
}
