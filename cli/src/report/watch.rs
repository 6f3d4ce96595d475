// SPDX-License-Identifier: MIT OR Apache-2.0
//! The processes of a report, which start and end while it is watched.
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tautline_executor::ForeignStatistics;

use super::run::{Run, unread};
use crate::verb::{End, Failure, Outcome};

/// Keeps files open, so that a process's statistics can be read after its end.
pub struct ObservedProcesses {
    domain: u32,
    /// Processes with a system file.
    processes: Vec<ForeignStatistics>,
    /// The files of processes without a system file.
    others: BTreeSet<PathBuf>,
    killed: usize,
    /// The previous reading; processes keep only their latest moments.
    last: Option<Run>,
}

impl ObservedProcesses {
    pub fn new(domain: u32) -> ObservedProcesses {
        ObservedProcesses { domain, processes: Vec::new(), others: BTreeSet::new(), killed: 0, last: None }
    }

    /// Adds new processes.
    pub fn refresh(&mut self) -> Outcome {
        let (found, killed) = tautline_system::shared_statistics(self.domain)?;
        self.killed += killed;
        for process in found {
            let is_known = self.processes.iter().any(|known| known.path() == process.path());
            if is_known || self.others.contains(process.path()) {
                continue;
            }
            match process.read().map_err(unread)? {
                // A process that is just starting has no statistics yet; it is checked again.
                None => {}
                Some(snapshot) if snapshot.process.system_path.as_os_str().is_empty() => {
                    self.others.insert(process.path().into());
                }
                Some(_) => self.processes.push(process),
            }
        }
        Ok(())
    }

    /// Waits until there is a process.
    pub fn wait_for_one(&mut self, end: &End) -> Outcome {
        self.refresh()?;
        while self.processes.is_empty() && !end.is_reached() {
            end.print_waiting_once(|| format!("a process with a system file in domain {}", self.domain));
            end.pause(Duration::from_millis(200));
            self.refresh()?;
        }
        Ok(())
    }

    pub fn all_ended(&self) -> bool {
        self.processes.iter().all(|process| !process.is_running())
    }

    /// The file that all processes were started with.
    pub fn system_path(&self) -> Outcome<PathBuf> {
        let mut paths = BTreeSet::new();
        for process in &self.processes {
            if let Some(snapshot) = process.read().map_err(unread)? {
                paths.insert(snapshot.process.system_path);
            }
        }
        let mut rest = paths.iter();
        match (rest.next(), rest.next()) {
            (Some(only), None) => Ok(only.clone()),
            (Some(first), Some(_)) => {
                let files =
                    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ");
                Err(Failure::unusable(format!(
                    "the processes of domain {} were started with several system files ({files}): name one, as in `taut report {}`",
                    self.domain,
                    first.display()
                )))
            }
            _ => Err(self.nothing()),
        }
    }

    /// The run up to now.
    pub fn gather(&mut self, path: &Path, system: &str) -> Outcome<Run> {
        let run = Run::gather(self.domain, path, system, &self.processes)?;
        if run.processes.is_empty() {
            return Err(self.nothing());
        }
        let run = match &self.last {
            Some(last) => run.with_moments_of(last),
            None => run,
        };
        self.last = Some(run.clone());
        Ok(run)
    }

    /// Prints how many processes were killed, or left without ending their contexts, if any.
    pub fn print_killed(&self) {
        if self.killed > 0 {
            eprintln!("Of the processes, {}.", killed_text(self.killed));
        }
    }

    fn nothing(&self) -> Failure {
        let killed = match self.killed {
            0 => String::new(),
            killed => format!(" ({})", killed_text(killed)),
        };
        Failure::unusable(format!(
            "no process of domain {} shows statistics: start one whose context is built with `.system(\"system.toml\")`, or one of ROS's \
             with TAUT_SYSTEM=system.toml, or name another domain with --domain or TAUT_DOMAIN{killed}",
            self.domain
        ))
    }
}

fn killed_text(killed: usize) -> String {
    let (count, it) = if killed == 1 { ("one".into(), "it") } else { (killed.to_string(), "them") };
    format!("{count} was killed or left without ending its context; what was left of {it} is removed")
}
