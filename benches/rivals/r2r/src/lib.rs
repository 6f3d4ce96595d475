// SPDX-License-Identifier: MIT OR Apache-2.0
//! What r2r's side of the benches has in common.

use std::error::Error;
use std::fs;
use std::process::ExitCode;

use r2r::Context;
use rustix::process::{Signal, set_parent_process_death_signal};
use serde::de::DeserializeOwned;

/// What nobody handles but the person who reads it.
pub type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// A program that `cargo xtask bench BENCH` starts with `--child` and a job as JSON, and ends with its parent; `--version` says what it is made of.
pub fn program<J: DeserializeOwned>(bench: &str, run: impl FnOnce(&J) -> Result<()>) -> ExitCode {
    let start = || -> Result<()> {
        let arguments: Vec<String> = std::env::args().skip(1).collect();
        match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
            ["--version"] => println!("{}", version()?),
            ["--child", job] => {
                set_parent_process_death_signal(Some(Signal::KILL))?;
                run(&serde_json::from_str(job)?)?;
            }
            _ => return Err(format!("to be started by `cargo xtask bench {bench}`").into()),
        }
        Ok(())
    };
    match start() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("r2r's side of {bench}: {error}");
            ExitCode::FAILURE
        }
    }
}

/// r2r's version, the distribution it was built with, and the libraries that it runs with.
///
/// # Errors
/// r2r makes no context, or /proc cannot be read.
pub fn version() -> Result<String> {
    let lock = include_str!("../../../Cargo.lock");
    let r2r = lock.split_once("name = \"r2r\"\nversion = \"").and_then(|(_, rest)| rest.split('"').next());
    let distribution = option_env!("ROS_DISTRO").unwrap_or("?");
    // With a context, the middleware is loaded.
    let _context = Context::create()?;
    let maps = fs::read_to_string("/proc/self/maps")?;
    let mut libraries: Vec<&str> = maps.lines().filter_map(|line| line.rsplit('/').next()).collect();
    libraries.retain(|name| name.starts_with("librmw_fastrtps_cpp") || name.starts_with("libfastrtps.so"));
    libraries.sort_unstable();
    libraries.dedup();
    Ok(format!("r2r {}, ROS 2 {distribution}, {}", r2r.unwrap_or("?"), libraries.join(", ")))
}
