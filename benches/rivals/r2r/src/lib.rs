// SPDX-License-Identifier: MIT OR Apache-2.0
//! What these programs are made of.

use std::error::Error;
use std::fs;

use r2r::Context;

/// r2r's version, the distribution it was built with, and the libraries that it runs with.
///
/// # Errors
/// r2r makes no context, or /proc cannot be read.
pub fn version() -> Result<String, Box<dyn Error>> {
    let lock = include_str!("../Cargo.lock");
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
