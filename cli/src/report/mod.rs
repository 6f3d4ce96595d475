// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut report`: compares the predictions of `taut check` with measurements.
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use crate::verb::{CommonArgs, End, Failure, Outcome};
use clap::Args;

mod explain;
mod host;
mod json;
pub mod overheads;
pub mod run;
mod system;
mod table;
mod verdict;
pub mod watch;
mod wcet;

use run::Run;
use system::{System, read};
use verdict::{Comparison, Verdict};
use watch::ObservedProcesses;
use wcet::{Change, Fits};

const REFRESH: Duration = Duration::from_secs(1);

/// Compares the measurements of callbacks with their predictions
///
/// Reads the statistics of every process of the domain whose context has a system file, without disturbing it, and compares
/// them with the analysis of that file: response times and bounds of callbacks and chains, execution times and wcet, releases and
/// periods, queues and capacities. If processes account for core time (TAUT_CORE_TIME=on), the report states for each response above its
/// bound what the host or other jobs took from the core. It names each violated assumption and its fix. Exits with 0 if no assumption was
/// violated, 1 if one was, 2 if there is nothing to compare.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut report                                 the system that runs, against the file it was started with
  taut report --watch                         again every second, until it ends or Ctrl-C
  taut report --watch --save run.json         and keep what it did until its end
  taut report run.json                        the report of a saved run
  taut report run.json --system system.toml   against another version of the file
  taut report run.json --wcet                 execution times, and what their tail says of longer ones
  taut report run.json --wcet --write         and into the system file what it has to state for that
  taut report --overheads                     what executors of rclcpp and rclpy use, for the system file
  taut report --json | jq '.callbacks[] | select(.violations != [])'

docs/report.md explains the columns and each violation.")]
pub struct ReportArgs {
    /// A system file, or a saved run; otherwise the file that the running processes were started with
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    /// The system file to compare with, if FILE is a saved run
    #[arg(long, value_name = "FILE")]
    system: Option<PathBuf>,
    /// Write the data of the report to FILE
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// Report again every second until all processes have ended, or --timeout
    #[arg(long)]
    watch: bool,
    /// Estimate execution times instead: the longest measured ones, and rarer ones by extreme-value theory. Exits with 1 if a job took
    /// longer, or had a larger input, than the file allows
    #[arg(long, conflicts_with = "watch")]
    wcet: bool,
    /// One job in 1/P may take longer than the estimate
    #[arg(long, value_name = "P", requires = "wcet", default_value = "1e-6", value_parser = exceedance)]
    exceedance: f64,
    /// Write the needed execution times into the system file, each with its source; larger values in the file stay
    #[arg(long, requires = "wcet")]
    write: bool,
    /// Also lower execution times in the file
    #[arg(long, requires = "write")]
    lower: bool,
    /// Print instead what executors of rclcpp and rclpy use for each callback, and the lines of the system file for it; of processes
    /// that run with TAUT_OVERHEADS=on
    #[arg(long, conflicts_with_all = ["file", "system", "save", "watch", "wcet"])]
    overheads: bool,
    #[command(flatten)]
    common: CommonArgs,
}

fn exceedance(text: &str) -> Result<f64, String> {
    let probability = text.parse::<f64>().ok().filter(|p| (1e-12..=1e-2).contains(p));
    probability.ok_or_else(|| format!("'{text}' is no number of 1e-12 to 0.01"))
}

/// Runs the verb; the exit code is the verdict.
pub fn run(args: &ReportArgs) -> Outcome<ExitCode> {
    Ok(ExitCode::from(report(args)? as u8))
}

fn report(args: &ReportArgs) -> Outcome<Verdict> {
    if args.overheads {
        return overheads::report(&args.common);
    }
    if let Some(path) = &args.file {
        let text = read(path)?;
        // A system file is TOML and does not begin with a brace.
        if text.trim_start().starts_with('{') {
            return report_saved(args, path, &text);
        }
    }
    if let Some(path) = &args.system {
        return Err(Failure::unusable(format!(
            "--system goes with a saved run; for a running system, name the file alone: `taut report {}`",
            path.display()
        )));
    }
    report_running(args)
}

fn report_saved(args: &ReportArgs, path: &Path, text: &str) -> Outcome<Verdict> {
    if args.watch || args.common.is_domain_named() {
        let text = "is a saved run: it cannot be watched, and has no domain to choose";
        return Err(Failure::unusable(format!("`{}` {text}", path.display())));
    }
    let mut run = Run::parse(path, text)?;
    if let Some(system) = &args.system {
        (run.system, run.system_path) = (read(system)?, system.clone());
    }
    let system = System::parse(&run.system_path, &run.system)?;
    if let Some(path) = &args.save {
        run.save(path)?;
    }
    Ok(print(args, &system, &run, false)?.verdict)
}

fn report_running(args: &ReportArgs) -> Outcome<Verdict> {
    let (domain, end) = (args.common.domain()?, End::of(&args.common)?);
    let mut processes = ObservedProcesses::new(domain);
    if args.watch {
        processes.wait_for_one(&end)?;
    }
    processes.refresh()?;
    let path = match &args.file {
        Some(path) => path.clone(),
        None => processes.system_path()?,
    };
    let system = System::parse(&path, &read(&path)?)?;
    loop {
        let last = !args.watch || end.is_reached() || processes.all_ended();
        let run = processes.gather(&path, &system.text)?;
        // Without a terminal, intermediate tables are omitted.
        let shown = last || args.common.json || io::stdout().is_terminal();
        let unshown = Printed { verdict: Verdict::Nothing, is_read: true };
        let Printed { verdict, is_read } =
            if shown { print(args, &system, &run, args.watch)? } else { unshown };
        if last || !is_read {
            processes.print_killed();
            if let Some(path) = &args.save {
                run.save(path)?;
                eprintln!("Saved: {0}; `taut report {0}` shows it again.", path.display());
            }
            return Ok(verdict);
        }
        end.pause(REFRESH);
        processes.refresh()?;
    }
}

/// What a report says, and whether it still has a reader.
struct Printed {
    verdict: Verdict,
    is_read: bool,
}

/// Whether the output still has a reader. That it has gone (`taut report | head`) is no error: the run is saved, and the verdict stays.
fn is_read(written: io::Result<()>) -> io::Result<bool> {
    match written {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        written => written.map(|()| true),
    }
}

fn print(args: &ReportArgs, system: &System, run: &Run, in_place: bool) -> Outcome<Printed> {
    let comparison = Comparison::new(&system.file, &system.checked, run);
    if args.wcet {
        return print_wcets(args, system, run, &comparison);
    }
    let is_read = is_read(write(args, run, &comparison, in_place))?;
    Ok(Printed { verdict: comparison.verdict, is_read })
}

fn write(args: &ReportArgs, run: &Run, comparison: &Comparison, in_place: bool) -> io::Result<()> {
    let mut out = crate::print::stdout();
    if args.common.json {
        json::write(comparison, &mut out)?;
    } else {
        if in_place && io::stdout().is_terminal() {
            write!(out, "{}", crate::print::clear())?;
        }
        table::write(comparison, run, &mut out)?;
    }
    out.flush()
}

fn print_wcets(args: &ReportArgs, system: &System, run: &Run, comparison: &Comparison) -> Outcome<Printed> {
    let fits = Fits::new(comparison, args.exceedance, run.taken_at_s);
    let change = if args.lower { Change::RaiseAndLower } else { Change::Raise };
    let changed = args.write.then(|| fits.put(system, &run.system_path, change)).transpose()?;
    let is_read = is_read(write_wcets(args, run, &fits, changed.as_ref()))?;
    let kept = match changed {
        // The file now states at least what was measured, except for the largest input, which only the user can state.
        Some((_, schedulable)) => schedulable && fits.inputs_are_kept(),
        None => fits.are_kept(),
    };
    let verdict = if comparison.jobs() == 0 { Verdict::Nothing } else { Verdict::of(kept) };
    Ok(Printed { verdict, is_read })
}

/// `changed`: the changes of the file in words, and whether it is schedulable with them.
fn write_wcets(
    args: &ReportArgs,
    run: &Run,
    fits: &Fits<'_>,
    changed: Option<&(Vec<String>, bool)>,
) -> io::Result<()> {
    let mut out = crate::print::stdout();
    if args.common.json {
        let mut report = fits.to_json();
        if let Some((changes, schedulable)) = changed {
            report["changes"] = serde_json::json!(changes);
            report["schedulable"] = serde_json::json!(schedulable);
        }
        writeln!(out, "{report}")?;
    } else {
        fits.write(&mut out)?;
        if let Some((changes, schedulable)) = changed {
            print_changes(&run.system_path, changes, *schedulable, &mut out)?;
        }
    }
    out.flush()
}

fn print_changes(path: &Path, changes: &[String], schedulable: bool, out: &mut impl Write) -> io::Result<()> {
    match changes {
        [] => writeln!(out, "{} states enough: nothing is changed.", path.display())?,
        _ => writeln!(out, "{} is changed:", path.display())?,
    }
    changes.iter().try_for_each(|change| writeln!(out, "  {change}"))?;
    if !schedulable {
        writeln!(out, "With that it is not schedulable: see `taut check {}`.", path.display())?;
    }
    Ok(())
}
