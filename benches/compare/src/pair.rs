// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processes of a measurement, and the one of round trips.

use std::fs::File;
use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use tautline_benches::{Process, Scratch};
use tautline_exchange::{Exchange, FutexPair, Job, Line, Measured, Role, Way, memory_kib};

use crate::Result;
use crate::modes::Program;
use crate::plan::{Case, Plan, Task};

/// How long a process may take to set itself up.
pub const PATIENCE: Duration = Duration::from_secs(30);
/// Tautline's and the rivals' domain, where they have one. Nobody else measures there, and no test runs there.
const DOMAIN: u32 = 89;

/// What every measurement needs.
pub struct Setup<'a> {
    pub plan: &'a Plan,
    pub scratch: &'a Scratch,
    pub interrupted: &'a AtomicBool,
}

/// What one measurement found.
#[derive(Debug, Default)]
pub struct Found {
    pub times_ns: Vec<u64>,
    pub lost: u64,
    /// Of all processes, or of one half of a round trip: the sending and the receiving of one message.
    pub cpu_ns: u64,
    pub messages: u64,
    pub seconds: f64,
    pub memory_kib: u64,
    /// Of the receiver's main thread, per message.
    pub switches: Option<f64>,
}

impl Setup<'_> {
    /// The job of one end of a case; `topic` is used nowhere else.
    pub fn job(&self, case: &Case, role: Role, topic: &str) -> Job {
        let (exchange, whole, topics, subscribers) = match case.task {
            Task::RoundTrips { whole } => (Exchange::RoundTrips, whole, 1, 1),
            Task::Paced { rate, topics, subscribers, .. } => {
                (Exchange::Paced { rate }, true, topics, subscribers)
            }
            Task::Stream => (Exchange::Stream { window: None }, true, 1, 1),
            Task::Start { topics, .. } => (Exchange::Paced { rate: 100.0 }, true, topics, 1),
        };
        let [near, far] = self.plan.cores;
        Job {
            role,
            exchange,
            payload_bytes: case.payload_bytes,
            budget: case.budget,
            core: Some(if role == Role::Near && !case.mode.one_core { near } else { far }),
            realtime: self.plan.realtime,
            domain: DOMAIN,
            topic: topic.to_owned(),
            endpoint: None,
            way: Way { mode: case.mode.mode.to_owned(), whole, topics, subscribers },
        }
    }

    /// Starts one end.
    pub fn start(&self, case: &Case, job: &Job) -> Result<Process<'_, Line>> {
        let mut command = match case.mode.program {
            Program::Own => {
                let mut command = Command::new(std::env::current_exe()?);
                command.args(["--child", case.mode.system, &serde_json::to_string(job)?]);
                command
            }
            Program::Json(name) => {
                let mut command = Command::new(self.plan.programs.find(name)?);
                command.arg(serde_json::to_string(job)?).env("ROS_DOMAIN_ID", DOMAIN.to_string());
                command
            }
            Program::Words(name) => {
                let mut command = Command::new(self.plan.programs.find(name)?);
                command.args(words(job));
                command
            }
        };
        Process::start(&mut command, format!("{:?} end", job.role), self.interrupted)
    }

    /// What a system's processes find each other by, if they need it.
    fn meeting_place(&self, case: &Case) -> Result<Option<String>> {
        Ok(match (case.mode.system, case.mode.mode) {
            ("floor", "futex") => {
                let path = PathBuf::from("/dev/shm").join(format!("{}futex", self.scratch.prefix()));
                let file = File::options().create(true).truncate(true).read(true).write(true).open(&path)?;
                file.set_len(FutexPair::memory_bytes(case.payload_bytes) as u64)?;
                Some(path.display().to_string())
            }
            ("iceoryx2", _) => Some(self.scratch.directory().display().to_string()),
            _ => None,
        })
    }

    /// The far end, before it is ready. One that comes late is told where the others are.
    pub fn spawn_far(&self, case: &Case, topic: &str, others: Option<String>) -> Result<Process<'_, Line>> {
        let endpoint = self.meeting_place(case)?.or(others);
        self.start(case, &Job { endpoint, ..self.job(case, Role::Far, topic) })
    }

    /// The far end, ready; and where the near one finds it.
    pub fn start_far(&self, case: &Case, topic: &str) -> Result<(Process<'_, Line>, Option<String>)> {
        let mut far = self.spawn_far(case, topic, None)?;
        let endpoint = far.expect(PATIENCE, |line| match line {
            Line::Ready(endpoint) => Some(endpoint),
            _ => None,
        })?;
        Ok((far, endpoint))
    }

    /// The near end, which uses `endpoint`.
    pub fn start_near(
        &self,
        case: &Case,
        topic: &str,
        endpoint: Option<String>,
    ) -> Result<Process<'_, Line>> {
        self.start(case, &Job { endpoint, ..self.job(case, Role::Near, topic) })
    }

    /// Measures round trips.
    pub fn round_trips(&self, case: &Case, topic: &str) -> Result<Found> {
        let alone = case.mode.mode == "memcpy";
        let (mut far, endpoint) = match alone {
            true => (None, None),
            false => {
                let (far, endpoint) = self.start_far(case, topic)?;
                (Some(far), endpoint)
            }
        };
        let mut near = self.start_near(case, topic, endpoint)?;
        let measured = measured(&mut near, PATIENCE + case.budget * 3)?;
        let mut memory = measured.memory_kib;
        near.finish()?;
        if let Some(far) = &mut far {
            memory += memory_kib(&far.id().to_string());
            far.finish()?;
        }
        if measured.times_ns.is_empty() {
            return Err("nothing arrived".into());
        }
        Ok(Found {
            messages: measured.times_ns.len() as u64,
            times_ns: measured.times_ns,
            lost: measured.lost,
            cpu_ns: measured.cpu_ns,
            seconds: measured.seconds,
            memory_kib: memory,
            switches: None,
        })
    }
}

/// What a process says that it measured.
pub fn measured(process: &mut Process<'_, Line>, patience: Duration) -> Result<Measured> {
    process.expect(patience, |line| match line {
        Line::Measured(measured) => Some(measured),
        _ => None,
    })
}

/// A job for a program that does not read JSON.
fn words(job: &Job) -> Vec<String> {
    let (kind, rate) = match job.exchange {
        Exchange::RoundTrips => ("round-trips", 0.0),
        Exchange::Paced { rate } => ("paced", rate),
        Exchange::Stream { .. } => ("stream", 0.0),
    };
    vec![
        format!("role={}", if job.role == Role::Near { "near" } else { "far" }),
        format!("kind={kind}"),
        format!("rate={rate}"),
        format!("payload_bytes={}", job.payload_bytes),
        format!("budget_ns={}", job.budget.as_nanos()),
        format!("core={}", job.core.map_or(String::new(), |core| core.to_string())),
        format!("realtime={}", u8::from(job.realtime)),
        format!("domain={}", job.domain),
        format!("topic={}", job.topic.trim_start_matches('/')),
        format!("mode={}", job.way.mode),
        format!("whole={}", u8::from(job.way.whole)),
        format!("topics={}", job.way.topics),
        format!("subscribers={}", job.way.subscribers),
    ]
}
