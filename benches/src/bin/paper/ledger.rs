// SPDX-License-Identifier: MIT OR Apache-2.0
//! The runs on disk: two hours of them survive a reboot, a kill and a full day.
//!
//! A line of JSON each. The first says under which [`Conditions`] the runs were made; runs of others are never mixed with
//! them. A line is written when its run has ended, so a kill costs the run that it hits.

use std::fs::{File, OpenOptions, TryLockError};
use std::hash::{DefaultHasher, Hasher};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tautline_harness::{machine, version_of};
use tautline_rt::Interruptions;

use crate::Result;
use crate::plan::Plan;
use crate::process::{Run, version};

/// What must be the same for runs to be counted together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Conditions {
    seconds: f64,
    core: usize,
    realtime: bool,
    machine: String,
    tautline: String,
    /// Unknown if it is left out.
    r2r: Option<String>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Session {
    /// What the machine took from the core before its runs: window, count, total, longest regular, longest (ns, but for the count).
    interruptions: [u64; 5],
    /// Tells the builds of the program apart.
    build: u64,
    /// How quiet the machine was; unknown of a session that was killed.
    #[serde(skip)]
    pub disturbance: Option<String>,
    /// From its start to the end of its last run, in seconds.
    #[serde(skip)]
    pub took_s: f64,
}

#[derive(Debug, Serialize, Deserialize)]
pub enum Entry {
    Conditions(Conditions),
    Session(Session),
    /// A run of `cell` ended, `at_s` seconds after the session's start.
    Run {
        cell: String,
        at_s: f64,
        run: Run,
    },
    Failed(String),
    End {
        disturbance: String,
    },
}

/// Everything that was measured under the same conditions, in this session and in those before it.
#[derive(Debug)]
pub struct Ledger {
    file: Option<(PathBuf, File)>,
    /// The runs, each with its cell's name, in the order in which they were made.
    pub runs: Vec<(String, Run)>,
    pub sessions: Vec<Session>,
    /// Runs that failed and were made again, and why they failed.
    pub failed: Vec<String>,
}

impl Ledger {
    /// Reads the file, or begins it; without a path nothing is kept.
    ///
    /// # Errors
    /// It cannot be read or written, another bench writes it, a line of it is none of this bench's, or its runs were made under
    /// other conditions.
    pub fn open(path: Option<&Path>, plan: &Plan) -> Result<Ledger> {
        let mut ledger = Ledger { file: None, runs: Vec::new(), sessions: Vec::new(), failed: Vec::new() };
        let Some(path) = path else { return Ok(ledger) };
        let shown = path.display();
        let options = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path);
        let mut file = options.map_err(|error| format!("cannot open {shown}: {error}"))?;
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => {
                return Err(format!("{shown}: another bench writes it; give --results another file").into());
            }
            Err(TryLockError::Error(error)) => return Err(format!("cannot lock {shown}: {error}").into()),
            Ok(()) => {}
        }
        let mut text = String::new();
        file.read_to_string(&mut text).map_err(|error| format!("cannot read {shown}: {error}"))?;
        // What a kill cut off in the middle of a line.
        let whole = text.rfind('\n').map_or(0, |end| end + 1);
        file.set_len(whole as u64)?;
        file.seek(SeekFrom::End(0))?;
        let mut before = None;
        for (number, line) in text[..whole].lines().enumerate() {
            let entry = serde_json::from_str(line).map_err(|error| {
                format!("{shown}, line {}: no results of this bench: {error}", number + 1)
            })?;
            match entry {
                Entry::Conditions(conditions) => before = Some(conditions),
                entry => ledger.take(entry),
            }
        }
        let now = conditions(plan)?;
        ledger.file = Some((path.to_owned(), file));
        match before {
            Some(before) => agree(&before, &now).map_err(|differs| {
                format!(
                    "the runs in {shown} are not of these conditions: {differs}; give --results another file"
                )
            })?,
            None if whole == 0 => ledger.write(&Entry::Conditions(now))?,
            None => return Err(format!("{shown} does not say under which conditions it was measured").into()),
        }
        Ok(ledger)
    }

    fn take(&mut self, entry: Entry) {
        match entry {
            Entry::Conditions(_) => {}
            Entry::Session(session) => self.sessions.push(session),
            Entry::Run { cell, at_s, run } => {
                self.runs.push((cell, run));
                if let Some(session) = self.sessions.last_mut() {
                    session.took_s = at_s;
                }
            }
            Entry::Failed(reason) => self.failed.push(reason),
            Entry::End { disturbance } => {
                if let Some(session) = self.sessions.last_mut() {
                    session.disturbance = Some(disturbance);
                }
            }
        }
    }

    fn write(&mut self, entry: &Entry) -> Result<()> {
        if let Some((path, file)) = &mut self.file {
            let line = serde_json::to_string(entry)? + "\n";
            let written = file.write_all(line.as_bytes()).and_then(|()| file.sync_data());
            written.map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        }
        Ok(())
    }

    pub fn add(&mut self, entry: Entry) -> Result<()> {
        self.write(&entry)?;
        self.take(entry);
        Ok(())
    }

    pub fn begin(&mut self, seen: &Interruptions) -> Result<()> {
        let interruptions = [seen.window_ns, seen.count, seen.total_ns, seen.regular_ns, seen.longest_ns];
        self.add(Entry::Session(Session { interruptions, build: build()?, ..Session::default() }))
    }

    pub fn path(&self) -> Option<&Path> {
        self.file.as_ref().map(|(path, _)| path.as_path())
    }

    /// What the machine took from the core in front of all sessions: their windows together, the longest of each kind.
    pub fn interruptions(&self) -> Interruptions {
        self.sessions.iter().fold(Interruptions::default(), |all, session| {
            let [window_ns, count, total_ns, regular_ns, longest_ns] = session.interruptions;
            Interruptions {
                window_ns: all.window_ns + window_ns,
                count: all.count + count,
                total_ns: all.total_ns + total_ns,
                regular_ns: all.regular_ns.max(regular_ns),
                longest_ns: all.longest_ns.max(longest_ns),
            }
        })
    }

    /// How many builds of the program made the runs.
    pub fn builds(&self) -> usize {
        let mut builds: Vec<_> = self.sessions.iter().map(|session| session.build).collect();
        builds.sort_unstable();
        builds.dedup();
        builds.len()
    }
}

fn conditions(plan: &Plan) -> Result<Conditions> {
    Ok(Conditions {
        seconds: plan.seconds,
        core: plan.core,
        realtime: plan.realtime,
        machine: machine(),
        tautline: version_of("tautline").unwrap_or("?").to_owned(),
        r2r: plan.r2r.as_ref().ok().map(|program| version(program)).transpose()?,
    })
}

/// Whether runs of both can be counted together; else what differs.
fn agree(before: &Conditions, now: &Conditions) -> std::result::Result<(), String> {
    let texts = |of: &Conditions| -> [String; 6] {
        let Conditions { seconds, core, realtime, machine, tautline, r2r } = of;
        let r2r = r2r.clone().unwrap_or("left out".to_owned());
        let (seconds, realtime) = (seconds.to_string(), realtime.to_string());
        [machine.clone(), core.to_string(), seconds, realtime, tautline.clone(), r2r]
    };
    let names = [
        "the machine",
        "the core (--core)",
        "the length of a run (--seconds)",
        "the use of real-time priorities (--no-rt)",
        "Tautline's version",
        "r2r",
    ];
    // What is left out now changes nothing of what was measured.
    let known = if now.r2r.is_some() { names.len() } else { names.len() - 1 };
    let both = texts(before).into_iter().zip(texts(now)).zip(names).take(known);
    match both.into_iter().find(|((before, now), _)| before != now) {
        Some(((before, now), what)) => Err(format!("{what} was `{before}` and is `{now}`")),
        None => Ok(()),
    }
}

fn build() -> Result<u64> {
    let mut hasher = DefaultHasher::new();
    hasher.write(&std::fs::read(std::env::current_exe()?)?);
    Ok(hasher.finish())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::plan;

    fn entry(cell: &str, at_s: f64, run: Run) -> Entry {
        Entry::Run { cell: cell.to_owned(), at_s, run }
    }

    fn run(steal_ticks: u64) -> Run {
        Run { steal_ticks, ..Run::default() }
    }

    fn seen(window_ns: u64, longest_ns: u64) -> Interruptions {
        Interruptions { window_ns, count: 1, total_ns: 2, regular_ns: 3, longest_ns }
    }

    #[test]
    fn a_killed_session_loses_the_line_that_it_wrote() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("results");
        let mut first = Ledger::open(Some(&path), &plan()).unwrap();
        first.begin(&seen(10, 7)).unwrap();
        first.add(entry("tautline futures", 1.5, run(4))).unwrap();
        first.add(Entry::Failed("a reason".into())).unwrap();
        drop(first);
        let whole = std::fs::read(&path).unwrap();
        for cut in [&b"{\"Run\":{\"cell\":\"tau"[..], b"{", b""] {
            std::fs::write(&path, [&whole, cut].concat()).unwrap();
            let mut second = Ledger::open(Some(&path), &plan()).unwrap();
            assert_eq!((second.runs.len(), second.runs[0].1.steal_ticks), (1, 4));
            assert_eq!((second.sessions[0].took_s, &second.sessions[0].disturbance), (1.5, &None));
            assert_eq!(second.failed, ["a reason"]);
            second.begin(&seen(20, 5)).unwrap();
            second.add(entry("r2r futures", 2.0, run(0))).unwrap();
            second.add(Entry::End { disturbance: "quiet".into() }).unwrap();
            drop(second);
            let third = Ledger::open(Some(&path), &plan()).unwrap();
            let cells: Vec<_> = third.runs.iter().map(|(cell, _)| cell.as_str()).collect();
            assert_eq!(cells, ["tautline futures", "r2r futures"]);
            assert_eq!(third.sessions[1].disturbance.as_deref(), Some("quiet"));
            assert_eq!(
                (third.interruptions(), third.builds()),
                (Interruptions { count: 2, total_ns: 4, ..seen(30, 7) }, 1)
            );
        }
    }

    #[test]
    fn runs_of_other_conditions_and_other_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("results");
        let open = |change: fn(&mut Plan)| {
            let mut plan = plan();
            change(&mut plan);
            Ledger::open(Some(&path), &plan).map(drop).map_err(|error| error.to_string())
        };
        assert_eq!(open(|_| {}), Ok(()));
        assert_eq!(open(|plan| plan.runs = 7), Ok(()), "more runs are more of the same");
        assert!(open(|plan| plan.seconds = 2.0).unwrap_err().contains("(--seconds) was `1` and is `2`"));
        assert!(open(|plan| plan.core = 1).unwrap_err().contains("(--core) was `0` and is `1`"));
        assert!(open(|plan| plan.realtime = false).unwrap_err().contains("--no-rt"));
        std::fs::write(&path, "a letter\n").unwrap();
        assert!(open(|_| {}).unwrap_err().contains("line 1: no results of this bench"));
        std::fs::write(&path, "{\"Failed\":\"x\"}\n").unwrap();
        assert!(open(|_| {}).unwrap_err().contains("under which conditions"));
        std::fs::remove_file(&path).unwrap();
        let _held = Ledger::open(Some(&path), &plan()).unwrap();
        assert!(open(|_| {}).unwrap_err().contains("another bench writes it"));
    }
}
