// SPDX-License-Identifier: MIT OR Apache-2.0
//! A recording in memory.

use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use tautline_trace::{Description, Event, ObjectId, Record};

/// All that was recorded, its events in order of time.
#[derive(Debug, Default)]
pub struct Recording {
    pub session: Option<Entry>,
    pub processes: BTreeMap<u32, Process>,
    pub events: Vec<TimedEvent>,
    pub warnings: Vec<String>,
}

/// An entry of a recording: everything but events.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
#[serde(tag = "record", rename_all = "snake_case")]
pub enum Entry {
    Session {
        domain: u32,
        taut: String,
        kernel: String,
        started_monotonic_ns: u64,
        started_unix_ns: i64,
        /// The host's name; empty in older recordings.
        #[serde(default)]
        host: String,
        /// Equal in recordings whose times are of one clock; empty if that is not known.
        #[serde(default)]
        clock: String,
    },
    Process {
        process: u32,
        pid: u32,
        name: String,
    },
    Object {
        process: u32,
        id: u64,
        kind: String,
        parent: u64,
        detail: u64,
        gid: [u64; 2],
        created_ns: u64,
        name: String,
    },
    Thread {
        process: u32,
        tid: u32,
        name: String,
    },
    Lost {
        process: u32,
        tid: u32,
        events: u64,
    },
    Unrecorded {
        process: u32,
        events: u64,
    },
    Undescribed {
        process: u32,
        objects: u64,
    },
    Ended {
        process: u32,
    },
    Finished {
        monotonic_ns: u64,
    },
}

impl Entry {
    /// The entry of a record; `None` for events, and for a record of a later version.
    pub fn of(record: &Record<'_>) -> Option<Self> {
        Some(match *record {
            Record::Process { process, pid, name } => Entry::Process { process, pid, name: name.to_owned() },
            Record::Object { process, object } => Entry::Object {
                process,
                id: object.id.0,
                kind: object.kind.name().to_owned(),
                parent: object.parent.0,
                detail: object.detail,
                gid: object.gid,
                created_ns: object.created_ns,
                name: object.name.clone(),
            },
            Record::Thread { process, tid, name } => Entry::Thread { process, tid, name: name.to_owned() },
            Record::Lost { process, tid, events } => Entry::Lost { process, tid, events },
            Record::Unrecorded { process, events } => Entry::Unrecorded { process, events },
            Record::Undescribed { process, objects } => Entry::Undescribed { process, objects },
            Record::Ended { process } => Entry::Ended { process },
            _ => return None,
        })
    }
}

#[derive(Debug, Default)]
pub struct Process {
    pub pid: u32,
    pub name: String,
    pub threads: BTreeMap<u32, String>,
    pub objects: BTreeMap<ObjectId, Description>,
    /// Overwritten events of each thread.
    pub lost: HashMap<u32, u64>,
    pub unrecorded: u64,
    pub undescribed: u64,
    /// Whether the process ended before the recording did.
    pub has_ended: bool,
}

impl Process {
    /// Number of its events that are known to be missing.
    pub fn events_lost(&self) -> u64 {
        self.lost.values().copied().fold(self.unrecorded, u64::saturating_add)
    }
}

/// An event and where it happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimedEvent {
    pub process: u32,
    pub tid: u32,
    pub event: Event,
}

impl Recording {
    /// A process's entry; created if it is missing, because a damaged file may not name the process first.
    pub fn process(&mut self, process: u32) -> &mut Process {
        self.processes.entry(process).or_default()
    }

    /// Puts the events in order of time. Those of one thread are in order already and stay so.
    pub fn finish(&mut self) {
        self.events.sort_by_key(|timed| timed.event.time_ns);
        let mut warn = |count: u64, what: &str| {
            if count != 0 {
                self.warnings.push(format!("{count} {what}"));
            }
        };
        let sum = |of: fn(&Process) -> u64| self.processes.values().map(of).fold(0, u64::saturating_add);
        warn(
            sum(|process| process.events_lost() - process.unrecorded),
            "events were overwritten before they were fetched: give threads larger rings with TAUT_TRACE_EVENTS",
        );
        warn(
            sum(|process| process.unrecorded),
            "events are missing of threads for which no ring was free (64 per process)",
        );
        warn(
            sum(|process| process.undescribed),
            "objects have no name: a process had more than 1024 at once",
        );
    }

    /// Events that are known to be missing.
    pub fn events_lost(&self) -> u64 {
        self.processes.values().map(Process::events_lost).fold(0, u64::saturating_add)
    }

    /// The kernel's id and the program of a process; 0 and empty if it is not described.
    pub fn program(&self, process: u32) -> (u32, &str) {
        self.processes.get(&process).map_or((0, ""), |of| (of.pid, of.name.as_str()))
    }

    /// The description of an event's object.
    pub fn object(&self, process: u32, id: ObjectId) -> Option<&Description> {
        self.processes.get(&process)?.objects.get(&id)
    }

    /// The name of a thread; its number if it has none.
    pub fn thread_name(&self, process: u32, tid: u32) -> String {
        let name = self.processes.get(&process).and_then(|process| process.threads.get(&tid));
        name.filter(|name| !name.is_empty()).cloned().unwrap_or_else(|| tid.to_string())
    }
}
