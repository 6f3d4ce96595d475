// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tests what other processes see of killed ones. Nothing may hang, be left behind, or be lost without being counted.
//!
//! This program starts itself again: the killed processes and the surviving ones are its parts.
//!
//! | module | holds |
//! |---|---|
//! | `random` | processes with every kind of endpoint, killed at random instants and replaced |
//! | `actors` | those processes |
//! | `survivors` | the processes that are not killed, and count messages |
//! | `syscalls` | scenarios in which one process is killed before and after each of its system calls |
//! | `scenes` | those scenarios, process by process |
//! | `tracer` | counts system calls, and kills |
//! | `inspector` | checks the domain as a newcomer |
//! | `folder` | owners of the domain's files, and how long files of dead processes stay |
//! | `process` | a part's process, as its parent sees it |
//! | `place` | the scope of all of them |

mod actors;
mod folder;
mod inspector;
mod place;
mod process;
mod random;
mod scenes;
mod survivors;
mod syscalls;
mod tracer;

use clap::{Args, Parser, Subcommand};
use std::process::ExitCode;

/// A result whose error is only printed.
type Result<T> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

/// Kills processes, and looks what the others see of it.
#[derive(Parser)]
#[command(after_help = "Examples:
  kills random --kills 20000
  kills syscalls
  kills syscalls --at attach:212:after")]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    /// Processes with every kind of end are killed at random instants and replaced
    Random(random::Options),
    /// A process is killed before and after each of its system calls
    Syscalls(syscalls::Options),
    /// What this program starts itself for
    #[command(hide = true)]
    Part(Part),
}

/// What both verbs are told.
#[derive(Args, Debug)]
struct Common {
    /// What is random goes by this [default: random]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Measure times, and do not judge them: other programs run
    #[arg(long)]
    no_limits: bool,
}

#[derive(Args, Clone, Debug)]
struct Part {
    /// Which
    name: String,
    /// What it does at random goes by this
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

fn main() -> ExitCode {
    let result = match Cli::parse().verb {
        Verb::Random(options) => random::run(&options),
        Verb::Syscalls(options) => syscalls::run(&options),
        Verb::Part(part) => play(&part),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{}: {error}", std::process::id());
            ExitCode::FAILURE
        }
    }
}

fn play(part: &Part) -> Result<()> {
    // The parent may be killed, too.
    rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::KILL))?;
    let (kind, name) = part.name.split_once('-').unwrap_or((&part.name, ""));
    match kind {
        "actor" => actors::play(name, part.seed),
        "survivor" => survivors::play(name),
        "scene" => scenes::play(name),
        "inspector" => inspector::play(),
        _ => Err(format!("no part {}", part.name).into()),
    }
}
