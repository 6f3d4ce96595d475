// SPDX-License-Identifier: MIT OR Apache-2.0
//! taktora-executor as its examples have it: items that what they subscribe to triggers, run in the executor's own thread;
//! channels with a loan per message, which is read in place.

mod ends;

use std::fs;
use std::path::Path;
use std::process::ExitCode;

use iceoryx2::config::Config;
use iceoryx2::prelude::{FilePath, LogLevel, SemanticString, set_log_level};
use tautline_exchange::{Exchange, Job, Result, Role, program};

fn main() -> ExitCode {
    program("rival-taktora", |job| run(&job))
}

fn run(job: &Job) -> Result<()> {
    set_log_level(LogLevel::Error);
    configure(job)?;
    match job.payload_bytes {
        64 => play::<8>(job),
        1024 => play::<128>(job),
        4096 => play::<512>(job),
        16384 => play::<2048>(job),
        65536 => play::<8192>(job),
        262144 => play::<32768>(job),
        1048576 => play::<131072>(job),
        4194304 => play::<524288>(job),
        8388608 => play::<1048576>(job),
        bytes => Err(format!("there is no frame of {bytes} bytes").into()),
    }
}

fn play<const WORDS: usize>(job: &Job) -> Result<()> {
    match (job.exchange, job.role) {
        (Exchange::RoundTrips, Role::Near) => ends::ask::<WORDS>(job),
        (Exchange::RoundTrips, Role::Far) => ends::answer::<WORDS>(job),
        _ => Err("this program exchanges round trips alone".into()),
    }
}

/// Files of its own, under the directory that is the job's endpoint, and as much room as the other systems have: taktora itself has
/// no settings for either, iceoryx2's are those of a file.
fn configure(job: &Job) -> Result<()> {
    let directory = Path::new(job.endpoint.as_deref().ok_or("no directory for files")?);
    let name = directory.file_name().and_then(|name| name.to_str()).ok_or("the directory has no name")?;
    // Names of sockets must be short.
    let prefix = name.rsplit_once('_').map_or(name, |(prefix, _)| prefix);
    let text = format!(
        "[global]\nroot-path = \"{}/t\"\nprefix = \"{prefix}_t_\"\n[defaults.publish-subscribe]\nmax-subscribers = 16\n\
         subscriber-max-buffer-size = 10\n",
        directory.display()
    );
    let file = directory.join(format!("taktora_{}.toml", std::process::id()));
    fs::write(&file, text)?;
    let path = file.to_str().ok_or("the directory's name is no UTF-8")?;
    Config::setup_global_config_from_file(&FilePath::new(path.as_bytes())?)?;
    Ok(fs::remove_file(&file)?)
}
