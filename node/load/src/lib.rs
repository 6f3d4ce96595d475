// SPDX-License-Identifier: MIT OR Apache-2.0
//! What runs in a domain, as its processes' statistics tell it to the analysis: for nodes that are admitted beside it, and for tools.
//!
//! ```
//! let running = tautline_load::Running::of_domain(226)?;
//! assert!(running.machine().is_empty(), "no process of this domain has real-time priorities");
//! # Ok::<(), std::io::Error>(())
//! ```
#![forbid(unsafe_code)]

use std::io::Result;
use std::path::Path;
use tautline_analysis::Reservation;
use tautline_analysis::file::SystemFile;
use tautline_analysis::file::admission::{LooseThread, Machine, Share};
use tautline_executor::{CallbackSnapshot, ForeignStatistics, ProcessInfo, ProcessSnapshot, StatisticsFile};
use tautline_rt::{Policy, policy_of};

/// The statistics of all processes of `domain`, of this user and on this host, that share them. `taut report` reads those of processes
/// with a system file. Statistics of killed processes are removed; their number is the second value.
///
/// ```
/// let (processes, _killed) = tautline_load::shared_statistics(227)?;
/// for process in processes {
///     if let Some(snapshot) = process.read()? {
///         println!("{} has {} callbacks", snapshot.process.program, snapshot.callbacks.len());
///     }
/// }
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// # Errors
/// /dev/shm cannot be read.
pub fn shared_statistics(domain: u32) -> Result<(Vec<ForeignStatistics>, usize)> {
    let found = ForeignStatistics::list(&StatisticsFile::prefix(domain))?;
    let before = found.len();
    let running: Vec<_> = found.into_iter().filter(|process| !process.remove_if_orphaned()).collect();
    let killed = before - running.len();
    Ok((running, killed))
}

/// What runs in a domain at real-time priorities, as far as its processes share their statistics.
#[derive(Debug, Default)]
pub struct Running {
    files: Vec<FileInUse>,
    threads: Vec<LooseThread>,
    /// Programs, with their process ids.
    pub processes: Vec<String>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

#[derive(Debug)]
struct FileInUse {
    file: SystemFile,
    host: String,
    label: String,
}

impl Running {
    /// Reads what runs in `domain` now, of this user and on this host. Processes without real-time priorities delay no
    /// real-time thread.
    ///
    /// # Errors
    /// /dev/shm cannot be read.
    pub fn of_domain(domain: u32) -> Result<Running> {
        Running::beside(domain, None)
    }

    /// As [`of_domain`](Self::of_domain), but of processes that have the file at this path only what another text of it does not count.
    ///
    /// # Errors
    /// As there.
    pub fn beside(domain: u32, without: Option<(&Path, &SystemFile)>) -> Result<Running> {
        let mut running = Running::default();
        let mut found = Vec::new();
        for statistics in shared_statistics(domain)?.0 {
            match statistics.read() {
                Ok(snapshot) => {
                    found.extend(snapshot.filter(|of| of.process.realtime && statistics.is_running()));
                }
                // Such as of a process that was built with another version of Tautline.
                Err(error) => running.notes.push(format!("a process is not looked at: {error}")),
            }
        }
        for snapshot in &mut found {
            if let Some((_, file)) = without.filter(|(path, _)| snapshot.process.system_path == *path) {
                let counts =
                    |of: &CallbackSnapshot| file.callbacks().iter().any(|entry| entry.name == of.name);
                snapshot.callbacks.retain(|callback| !counts(callback));
                continue;
            }
            running.processes.push(label_of(&snapshot.process));
            running.add_file(&snapshot.process);
        }
        let mut seen = Vec::new();
        for snapshot in &found {
            for callback in snapshot.callbacks.iter().filter(|of| !of.is_group && !of.ended) {
                running.add_callback(snapshot, callback, &mut seen);
            }
        }
        Ok(running)
    }

    /// The load, for the analysis.
    pub fn machine(&self) -> Machine<'_> {
        let mut machine = Machine::default();
        for FileInUse { file, host, label } in &self.files {
            machine.add_file(Share { file, host, label });
        }
        self.threads.iter().for_each(|thread| machine.add_thread(thread.clone()));
        machine
    }

    /// Counts a thread that shares no statistics yet.
    pub fn add_thread(&mut self, thread: LooseThread) {
        self.threads.push(thread);
    }

    fn add_file(&mut self, process: &ProcessInfo) {
        if process.system_path.as_os_str().is_empty() || self.file_of(process).is_some() {
            return;
        }
        let label = process.system_path.display().to_string();
        match SystemFile::read(&process.system_path) {
            Ok(file) if file.fingerprint() == process.system_hash => {
                self.files.push(FileInUse { file, host: process.host.clone(), label });
            }
            // What it runs says of itself what it needs.
            Ok(_) => self.notes.push(format!(
                "{} was started with another text of {label}: of it only what runs now is looked at; restart it",
                label_of(process)
            )),
            Err(error) => self.notes.push(format!(
                "{}: of it only what runs now is looked at: {error}",
                label_of(process)
            )),
        }
    }

    fn file_of(&self, process: &ProcessInfo) -> Option<&FileInUse> {
        let is_it =
            |used: &&FileInUse| used.file.fingerprint() == process.system_hash && used.host == process.host;
        self.files.iter().find(is_it)
    }

    /// A callback that is where its file says is part of the file, the first time.
    fn add_callback(
        &mut self,
        snapshot: &ProcessSnapshot,
        callback: &CallbackSnapshot,
        seen: &mut Vec<(u64, String, String)>,
    ) {
        let Some(priority) = callback.priority else { return };
        let process = &snapshot.process;
        let reservation = policy_of(callback.tid).ok().and_then(reservation_of);
        if self.file_of(process).is_some_and(|used| {
            used.file.callbacks().iter().any(|entry| {
                let core = &used.file.cores()[entry.core];
                (entry.name.as_str(), entry.priority, core.host.as_str())
                    == (callback.name.as_str(), priority, process.host.as_str())
                    && (entry.floats || callback.core == Some(core.number))
                    && entry.reservation == reservation
            })
        }) {
            let key = (process.system_hash, process.host.clone(), callback.name.clone());
            if !seen.contains(&key) {
                return seen.push(key);
            }
        }
        self.threads.push(LooseThread {
            name: callback.name.clone(),
            label: label_of(process),
            core: callback.core,
            priority,
            reservation,
            period_ns: callback.period_ns,
            jitter_ns: 0,
            budget_ns: callback.budget_ns,
            deadline_ns: callback.deadline_ns,
        });
    }
}

/// A process as messages name it.
pub fn label_of(process: &ProcessInfo) -> String {
    format!("{} (process {})", process.program, process.pid)
}

/// What the kernel reserves for a thread.
pub fn reservation_of(policy: Policy) -> Option<Reservation> {
    match policy {
        Policy::Deadline { runtime_ns, period_ns } => Some(Reservation { runtime_ns, period_ns }),
        _ => None,
    }
}
