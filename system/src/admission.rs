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

use crate::error::{Result, SystemError};
use crate::loaded::LoadedSystem;
use crate::statistics::shared_statistics;
use std::cell::OnceCell;
use std::fs::{File, TryLockError};
use std::os::fd::AsFd;
use std::path::Path;
use std::time::Duration;
use tautline_analysis::file::admission::{Broken, Candidate, LooseThread, Machine, Share};
use tautline_analysis::file::{CheckedCallback, CheckedSystem, SystemFile};
use tautline_analysis::{Release, Reservation};
use tautline_executor::{Admitted, CallbackOptions, CallbackSnapshot, ProcessInfo, ProcessSnapshot};
use tautline_rt::{Patience, Policy, domain::shared_path, fork::ProcessFd};

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
/// The maximum number of deadlines, or of processes, that an error names.
const NAMED: usize = 3;

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
    /// Its analysis, once it is needed.
    checked: OnceCell<CheckedSystem>,
    host: String,
    label: String,
}

impl FileInUse {
    /// How many topics, or timers, release the callback `name`, and how late each may be.
    fn releases_of(&self, name: &str) -> (usize, u64) {
        let checked = self.checked.get_or_init(|| self.file.check());
        let callback = checked.callbacks.iter().find(|of| of.entry.name == name && of.host == self.host);
        callback.map_or((1, 0), streams_of)
    }
}

impl Running {
    /// Reads what runs in `domain` now, of this user and on this host. Processes without real-time priorities delay no
    /// real-time thread.
    ///
    /// # Errors
    /// [`SystemError::Unreadable`].
    pub fn of_domain(domain: u32) -> Result<Running> {
        Running::beside(domain, None)
    }

    /// As [`of_domain`](Self::of_domain), but of processes with the file at this path only the callbacks that the given text of it lacks.
    pub fn beside(domain: u32, without: Option<(&Path, &SystemFile)>) -> Result<Running> {
        let mut running = Running::default();
        let mut found = Vec::new();
        for statistics in shared_statistics(domain)?.0 {
            match statistics.read() {
                Ok(snapshot) => {
                    found.extend(snapshot.filter(|of| of.process.realtime && statistics.is_running()));
                }
                // For example, a process that was built with another version of Tautline.
                Err(error) => running.notes.push(format!("a process is not looked at: {error}")),
            }
        }
        for snapshot in &mut found {
            if let Some((_, file)) =
                without.filter(|(path, _)| is_one_file(&snapshot.process.system_path, path))
            {
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
        for FileInUse { file, host, label, .. } in &self.files {
            machine.add_file(Share { file, host, label });
        }
        self.threads.iter().for_each(|thread| machine.add_thread(thread.clone()));
        machine
    }

    fn add_file(&mut self, process: &ProcessInfo) {
        if process.system_path.as_os_str().is_empty() || self.file_of(process).is_some() {
            return;
        }
        let label = process.system_path.display().to_string();
        match SystemFile::read(&process.system_path) {
            Ok(file) if file.fingerprint() == process.system_hash => {
                let (checked, host) = (OnceCell::new(), process.host.clone());
                self.files.push(FileInUse { file, checked, host, label });
            }
            // Only the callbacks that run now count, with the needs that their statistics state.
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

    /// Adds a callback as a thread beside the files, unless it runs as its file says, and is the first one that does.
    fn add_callback(
        &mut self,
        snapshot: &ProcessSnapshot,
        callback: &CallbackSnapshot,
        seen: &mut Vec<(u64, String, String)>,
    ) {
        let Some(priority) = callback.priority else { return };
        let process = &snapshot.process;
        let reservation = callback.reservation.and_then(reservation_of);
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
        let (streams, jitter_ns) =
            self.file_of(process).map_or((1, 0), |used| used.releases_of(&callback.name));
        self.threads.push(LooseThread {
            name: callback.name.clone(),
            label: label_of(process),
            core: callback.core,
            priority,
            reservation,
            period_ns: callback.period_ns,
            streams,
            jitter_ns,
            budget_ns: callback.budget_ns,
            deadline_ns: callback.deadline_ns,
        });
    }
}

/// Whether a callback of a system file already runs, in any process.
fn is_callback_running(domain: u32, system: &LoadedSystem, callback: &str) -> Result<bool> {
    let is_it =
        |of: &CallbackSnapshot| !of.is_group && !of.ended && of.priority.is_some() && of.name == callback;
    for statistics in shared_statistics(domain)?.0 {
        let Ok(Some(snapshot)) = statistics.read() else { continue };
        let has_file = system.is_of(&snapshot.process);
        if has_file && statistics.is_running() && snapshot.callbacks.iter().any(is_it) {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Whether two paths lead to one file, by symbolic links or `..`.
pub fn is_one_file(one: &Path, other: &Path) -> bool {
    one == other || one.canonicalize().is_ok_and(|one| other.canonicalize().is_ok_and(|other| one == other))
}

/// The name of a process in messages.
pub fn label_of(process: &ProcessInfo) -> String {
    format!("{} (process {})", process.program, process.pid)
}

/// Held by the process that is being admitted; the kernel releases it if that process dies.
#[derive(Debug)]
pub struct Gate(Option<ProcessFd>);

impl Gate {
    /// Locks the folder of a domain that this process has joined.
    ///
    /// # Errors
    /// [`SystemError::AdmissionBusy`], [`SystemError::Unreadable`].
    pub fn enter(domain: u32, mode: Admission) -> Result<Gate> {
        let path = shared_path(domain);
        let mut patience = Patience::new(PATIENCE);
        loop {
            match Gate::try_enter(&path) {
                Ok(gate) => return Ok(gate),
                Err(TryLockError::Error(source)) => return Err(SystemError::Unreadable { domain, source }),
                Err(TryLockError::WouldBlock) if !patience.is_over() => {
                    std::thread::sleep(Duration::from_millis(1));
                }
                Err(TryLockError::WouldBlock) if mode == Admission::Force => return Ok(Gate(None)),
                Err(TryLockError::WouldBlock) => {
                    return Err(SystemError::AdmissionBusy { domain, folder: path, waited: PATIENCE });
                }
            }
        }
    }

    fn try_enter(path: &Path) -> std::result::Result<Gate, TryLockError> {
        // A child that is forked between these would keep the lock.
        let folder = ProcessFd::make(|| {
            let folder = File::open(path).map_err(TryLockError::Error)?;
            folder.try_lock()?;
            Ok(folder.into())
        });
        folder.map(|folder| Gate(Some(folder)))
    }

    /// Whether no process holds the gate of a domain.
    pub fn is_free(domain: u32) -> bool {
        Gate::try_enter(&shared_path(domain)).is_ok()
    }
}

impl Drop for Gate {
    /// Unlocks explicitly: a child that another thread has spawned may keep the descriptor open until its exec.
    fn drop(&mut self) {
        let folder = self.0.as_ref().map(|folder| folder.as_fd().try_clone_to_owned());
        if let Some(Ok(folder)) = folder {
            let _ = File::from(folder).unlock();
        }
    }
}

/// Checks everything that the file states for this host. Hold the gate until other processes can read the load.
///
/// # Errors
/// [`SystemError::NotAdmitted`], and those of [`Gate::enter`].
pub fn admit_system(domain: u32, mode: Admission, system: &LoadedSystem) -> Result<(Gate, Admitted)> {
    let gate = Gate::enter(domain, mode)?;
    let running = Running::of_domain(domain)?;
    let label = system.label();
    let candidate = Candidate::File(Share { file: &system.file, host: &system.host, label: &label });
    let admitted = decide(domain, mode, &running, &candidate, &label, Some(&label))?;
    Ok((gate, admitted))
}

/// Checks callbacks that are to be spawned on a thread with the settings `thread`. Hold the gate until they are spawned.
///
/// # Errors
/// As [`admit_system`].
pub fn admit_callbacks<'o>(
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
            && !is_callback_running(domain, system, &callback.name)?
        {
            continue;
        }
        let running = match &mut running {
            Some(running) => running,
            none => none.insert(Running::of_domain(domain)?),
        };
        let loose = loose_thread(thread, callback, of_file);
        let silent = loose.period_ns.is_none() || loose.budget_ns.is_none();
        let hint = if silent { " (which states no `period` or no `budget`)" } else { "" };
        let what = format!("callback '{}'{hint}", callback.name);
        let candidate = Candidate::Thread(loose.clone());
        if let forced @ Admitted::Forced(_) = decide(domain, mode, running, &candidate, &what, None)? {
            outcome = forced;
        }
        running.threads.push(loose);
    }
    Ok((gate, outcome))
}

/// Describes a callback that no file counts, for the analysis.
fn loose_thread(
    thread: &CallbackOptions,
    callback: &CallbackOptions,
    of_file: Option<&LoadedSystem>,
) -> LooseThread {
    let ns = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    // A thread with a reservation may use any core, unless it is bound.
    let reservation = reservation_of(thread.policy);
    let cores =
        thread.cores.or_else(|| tautline_rt::current_affinity().ok().filter(|_| reservation.is_none()));
    let mut cores = cores.iter().flat_map(|cores| cores.iter());
    let entry = of_file.and_then(|system| system.find(&callback.name).ok());
    let (streams, jitter_ns) = entry.map_or((1, 0), streams_of);
    LooseThread {
        name: callback.name.clone(),
        label: label_of(&ProcessInfo::of_this()),
        core: cores.next().filter(|_| cores.next().is_none()),
        priority: thread.policy.realtime_priority().unwrap_or(1),
        reservation,
        period_ns: callback.period.map(ns),
        streams,
        jitter_ns,
        budget_ns: callback.budget.map(ns),
        deadline_ns: callback.effective_deadline().map(ns),
    }
}

/// How many topics, or timers, release a callback, and how late each may be.
fn streams_of(callback: &CheckedCallback) -> (usize, u64) {
    let jitter_ns = callback.releases.iter().map(Release::jitter_ns).max().unwrap_or(0);
    (callback.releases.len().max(1), jitter_ns)
}

/// Returns the reservation of a policy, if it is one.
fn reservation_of(policy: Policy) -> Option<Reservation> {
    match policy {
        Policy::Deadline { runtime_ns, period_ns } => Some(Reservation { runtime_ns, period_ns }),
        _ => None,
    }
}

/// Checks a candidate together with the running load. `what` names the candidate; `file` is its path, if it is a system file.
///
/// # Errors
/// [`SystemError::NotAdmitted`], unless `mode` is [`Admission::Force`].
pub fn decide(
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
    Err(SystemError::NotAdmitted { what: what.to_owned(), domain, late, beside, table })
}

fn late(broken: &[Broken]) -> String {
    let mut text = broken.iter().take(NAMED).map(ToString::to_string).collect::<Vec<_>>().join("; ");
    if broken.len() > NAMED {
        text.push_str(&format!("; and {} more", broken.len() - NAMED));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_executor::{ForeignCallback, ForeignStatistics, StatisticsFile};

    /// A container need not have the process ids of others.
    #[test]
    fn a_reservation_counts_although_its_thread_cannot_be_looked_at() {
        let prefix = format!("taut_system_test_{}_", std::process::id());
        let file = StatisticsFile::create(&prefix, &ProcessInfo::of_this()).unwrap();
        let [runtime, period] = [2, 20].map(Duration::from_millis);
        // Its thread has no id yet.
        let options = CallbackOptions::reserved(runtime, period).name("scan");
        let _callback = ForeignCallback::new(&file, &options).unwrap();
        let snapshot = ForeignStatistics::list(&prefix).unwrap()[0].read().unwrap().unwrap();
        let mut running = Running::default();
        running.add_callback(&snapshot, &snapshot.callbacks[0], &mut Vec::new());
        let reservation = Reservation { runtime_ns: 2_000_000, period_ns: 20_000_000 };
        assert_eq!(running.threads[0].reservation, Some(reservation));
    }

    #[test]
    fn a_domain_that_cannot_be_read_is_named_with_what_helps() {
        tautline_rt::domain::test_scope("test");
        let said = Gate::enter(9, Admission::Check).unwrap_err().to_string();
        assert!(said.starts_with("what runs in domain 9 cannot be read: "), "{said}");
        assert!(said.contains("TAUT_ADMISSION=off"), "{said}");
    }

    /// By hand: two jobs of `drive` are released at once, and `low` ends after 10 + 10 + 25 ms. One each 50 ms would leave it 10 + 25 ms.
    #[test]
    fn messages_of_several_topics_that_release_a_second_instance_come_at_once() {
        let path = std::env::temp_dir().join(format!("tautline-streams-{}.toml", std::process::id()));
        let text = "[hosts.robot]\ncores = 1\n[nodes.n]\n[topics]\na = { period = \"100ms\" }\nb = { period = \"100ms\" }\n\
                    [callbacks.drive]\ntopic = [\"a\", \"b\"]\nwcet = \"10ms\"\npriority = 50\n";
        std::fs::write(&path, text).unwrap();
        let system = LoadedSystem::read(&path, None).unwrap();
        std::fs::remove_file(&path).unwrap();
        let (file, checked, host) = (system.file.clone(), OnceCell::new(), system.host.clone());
        let used = FileInUse { file, checked, host, label: system.label() };
        assert_eq!(used.releases_of("drive"), (2, 0));
        let options = system.options("drive").unwrap();
        let drive = loose_thread(&options, &options, Some(&system));
        let ms = 1_000_000;
        let low = LooseThread {
            name: "low".into(),
            priority: 10,
            streams: 1,
            budget_ns: Some(25 * ms),
            deadline_ns: Some(40 * ms),
            ..drive.clone()
        };
        let mut machine = Machine::default();
        machine.add_thread(drive);
        let late = |deadline_ns| {
            let low = LooseThread { deadline_ns: Some(deadline_ns), ..low.clone() };
            machine.admit(&Candidate::Thread(low)).broken.iter().map(|of| of.response_ns).collect::<Vec<_>>()
        };
        assert_eq!((late(45 * ms), late(40 * ms)), (vec![], vec![Some(45 * ms)]));
    }
}
