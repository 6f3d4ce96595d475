// SPDX-License-Identifier: MIT OR Apache-2.0
//! The statistics of a domain's processes.

use crate::error::{Result, SystemError};
use tautline_executor::{ForeignStatistics, StatisticsFile};

/// The statistics of all processes of `domain`, of this user and on this host, that share them. `taut report` reads those of processes
/// with a system file. Statistics of killed processes are removed; their number is the second value.
///
/// ```
/// let (processes, _killed) = tautline_system::shared_statistics(227)?;
/// for process in processes {
///     if let Some(snapshot) = process.read()? {
///         println!("{} has {} callbacks", snapshot.process.program, snapshot.callbacks.len());
///     }
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`SystemError::Unreadable`] if /dev/shm cannot be read.
pub fn shared_statistics(domain: u32) -> Result<(Vec<ForeignStatistics>, usize)> {
    let found = ForeignStatistics::list(&StatisticsFile::prefix(domain))
        .map_err(|source| SystemError::Unreadable { domain, source })?;
    let before = found.len();
    let running: Vec<_> = found.into_iter().filter(|process| !process.remove_if_orphaned()).collect();
    let killed = before - running.len();
    Ok((running, killed))
}
