// SPDX-License-Identifier: MIT OR Apache-2.0
//! Admission: new load is checked against the load that runs in the domain, by an analysis of both together.
//!
//! | new load | is counted as |
//! |---|---|
//! | a context with a system file | everything in the file for this host |
//! | a callback with the priority and the core that the file gives it | already part of the file, unless it also runs elsewhere |
//! | any other real-time callback | its period, jitter and budget, on its core |
//!
//! The running load is read from the statistics that processes share: their system files, and the threads that are not in these
//! files. A process that is being admitted holds a lock of the domain until other processes can read its load. So if each of two
//! processes fits alone but not both together, one of them is refused.

use crate::error::{Error, Result};
use crate::system::LoadedSystem;
use std::fs::{File, TryLockError};
use std::time::Duration;
use tautline_analysis::file::admission::{Broken, Candidate, LooseThread, Share};
use tautline_executor::{Admitted, CallbackOptions, CallbackSnapshot, ProcessInfo};
use tautline_load::{Running, label_of, reservation_of, shared_statistics};
use tautline_rt::{Patience, domain::shared_path};

/// Whether new load is checked against the load that runs in the domain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Admission {
    /// Load that would cause a missed deadline is refused.
    Check,
    /// It runs nevertheless: a warning and `taut report` state what would be late.
    Force,
    /// Nothing is checked.
    Off,
}

/// How long a process waits for another one that is just being admitted.
const PATIENCE: Duration = Duration::from_secs(30);
/// As many deadlines as an error names.
const NAMED: usize = 3;

/// Whether a callback of a system file runs already, in whatever process.
fn runs(domain: u32, system: &LoadedSystem, callback: &str) -> Result<bool> {
    let is_it =
        |of: &CallbackSnapshot| !of.is_group && !of.ended && of.priority.is_some() && of.name == callback;
    for statistics in shared_statistics(domain).map_err(Error::Statistics)?.0 {
        let Ok(Some(snapshot)) = statistics.read() else { continue };
        let has_file = system.is_of(&snapshot.process);
        if has_file && statistics.is_running() && snapshot.callbacks.iter().any(is_it) {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Held by the process that is being admitted; the kernel releases it if that process dies.
#[derive(Debug)]
pub(crate) struct Gate(Option<File>);

impl Gate {
    /// Locks the folder of a domain that this process has joined.
    pub(crate) fn enter(domain: u32, mode: Admission) -> Result<Gate> {
        let path = shared_path(domain);
        let folder = File::open(&path).map_err(Error::Statistics)?;
        let mut patience = Patience::new(PATIENCE);
        loop {
            match folder.try_lock() {
                Ok(()) => break,
                Err(TryLockError::Error(error)) => return Err(Error::Statistics(error)),
                Err(TryLockError::WouldBlock) if !patience.is_over() => {
                    std::thread::sleep(Duration::from_millis(1));
                }
                Err(TryLockError::WouldBlock) if mode == Admission::Force => return Ok(Gate(None)),
                Err(TryLockError::WouldBlock) => {
                    return Err(Error::AdmissionBusy { domain, folder: path, waited: PATIENCE });
                }
            }
        }
        Ok(Gate(Some(folder)))
    }
}

impl Drop for Gate {
    /// Not by closing alone: a child of another thread may have the descriptor for a moment, before it becomes another program.
    fn drop(&mut self) {
        if let Some(folder) = &self.0 {
            let _ = folder.unlock();
        }
    }
}

/// Checks all that the file says of this host. The gate is to be held until others can read of it.
pub(crate) fn admit_system(domain: u32, mode: Admission, system: &LoadedSystem) -> Result<(Gate, Admitted)> {
    let gate = Gate::enter(domain, mode)?;
    let running = Running::of_domain(domain).map_err(Error::Statistics)?;
    let label = system.label();
    let candidate = Candidate::File(Share { file: &system.file, host: &system.host, label: &label });
    let admitted = decide(domain, mode, &running, &candidate, &label, Some(&label))?;
    Ok((gate, admitted))
}

/// Checks callbacks that are to be spawned on a thread with the settings `thread`. The gate is to be held until they are.
pub(crate) fn admit_callbacks<'o>(
    domain: u32,
    mode: Admission,
    system: Option<&LoadedSystem>,
    thread: &CallbackOptions,
    callbacks: impl Iterator<Item = &'o CallbackOptions>,
) -> Result<(Gate, Admitted)> {
    let gate = Gate::enter(domain, mode)?;
    let (mut running, mut outcome) = (None, Admitted::Checked);
    for callback in callbacks {
        let of_file = system.filter(|system| system.describes(thread, &callback.name));
        if let Some(system) = of_file
            && !runs(domain, system, &callback.name)?
        {
            continue;
        }
        let running = match &mut running {
            Some(running) => running,
            none => none.insert(Running::of_domain(domain).map_err(Error::Statistics)?),
        };
        let loose = loose(thread, callback, of_file);
        let silent = loose.period_ns.is_none() || loose.budget_ns.is_none();
        let hint = if silent { " (which states no `period` or no `budget`)" } else { "" };
        let what = format!("callback '{}'{hint}", callback.name);
        let candidate = Candidate::Thread(loose.clone());
        if let forced @ Admitted::Forced(_) = decide(domain, mode, running, &candidate, &what, None)? {
            outcome = forced;
        }
        running.add_thread(loose);
    }
    Ok((gate, outcome))
}

/// What the analysis needs to know of a callback that no file counts.
fn loose(
    thread: &CallbackOptions,
    callback: &CallbackOptions,
    of_file: Option<&LoadedSystem>,
) -> LooseThread {
    let ns = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    // With a reservation any, unless it is bound.
    let reservation = reservation_of(thread.policy);
    let cores =
        thread.cores.or_else(|| tautline_rt::current_affinity().ok().filter(|_| reservation.is_none()));
    let mut cores = cores.iter().flat_map(|cores| cores.iter());
    LooseThread {
        name: callback.name.clone(),
        label: label_of(&ProcessInfo::of_this()),
        core: cores.next().filter(|_| cores.next().is_none()),
        priority: thread.policy.realtime_priority().unwrap_or(1),
        reservation,
        // Of several topics any may send at once: as if one sent as often as all together.
        period_ns: callback
            .period
            .map(|period| ns(period) / of_file.map_or(1, |of| of.streams(&callback.name))),
        jitter_ns: of_file.map_or(0, |system| system.jitter_ns(&callback.name)),
        budget_ns: callback.budget.map(ns),
        deadline_ns: callback.effective_deadline().map(ns),
    }
}

pub(crate) fn decide(
    domain: u32,
    mode: Admission,
    running: &Running,
    candidate: &Candidate,
    what: &str,
    file: Option<&str>,
) -> Result<Admitted> {
    running.notes.iter().for_each(|note| tracing::warn!("{note}"));
    let broken = running.machine().admit(candidate).broken;
    if broken.is_empty() {
        return Ok(Admitted::Checked);
    }
    let late = late(&broken);
    if mode == Admission::Force {
        tracing::warn!("{what} runs by force: {late}");
        return Ok(Admitted::Forced(format!("{what}: {late}")));
    }
    let beside = match running.processes.len() {
        0 => "nothing".to_owned(),
        count @ 1..=NAMED => running.processes[..count].join(", "),
        count => format!("{} and {} more", running.processes[..NAMED].join(", "), count - NAMED),
    };
    let table = match file {
        Some(file) => format!("`taut check {file} --admit` shows all response times"),
        None => "`taut report` shows what runs".to_owned(),
    };
    let table = format!("{table}; TAUT_ADMISSION=force runs it all the same, and `taut report` says so");
    Err(Error::NotAdmitted { what: what.to_owned(), domain, late, beside, table })
}

fn late(broken: &[Broken]) -> String {
    let mut text = broken.iter().take(NAMED).map(ToString::to_string).collect::<Vec<_>>().join("; ");
    if broken.len() > NAMED {
        text.push_str(&format!("; and {} more", broken.len() - NAMED));
    }
    text
}
