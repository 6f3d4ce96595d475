// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processes of a measurement, and the one of round trips.

use std::fs::File;
use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use tautline_exchange::{Exchange, FutexPair, FutexRing, Job, Line, Measured, PEERS, Role, Way};
use tautline_harness::rows::{Wakes, rounded};
use tautline_harness::{Gateways, Host, Process, Scratch, without_settings};

use crate::Result;
use crate::modes::{GATEWAY, Program};
use crate::plan::{Case, Plan, Task, WINDOW_BYTES};

/// How long a process may take to set itself up.
pub const PATIENCE: Duration = Duration::from_secs(15);
/// Tautline's and the rivals' domain, where they have one. Nobody else measures there, and no test runs there.
const DOMAIN: u32 = 89;
/// The far end's over gateways, and the one in which they meet.
pub const FAR_DOMAIN: u32 = 90;
const NETWORK_DOMAIN: u32 = 91;

/// Processes beside the ends; they end with it.
pub struct Around<'a> {
    gateways: Option<Gateways<'a>>,
    daemon: Option<Process<'a, Line>>,
}

impl Around<'_> {
    /// Whether what ran beside a measurement is still there: without it the ends would have used somebody else's.
    pub fn still_runs(&mut self) -> Result<()> {
        self.daemon.as_mut().map_or(Ok(()), Process::still_runs)
    }

    /// How often a gateway used up its budget.
    pub fn throttled(&mut self) -> Option<u64> {
        let gateways = self.gateways.as_mut()?;
        [0, 1].into_iter().map(|host| gateways.throttled(host)).max()
    }
}

/// Not killed: that would leave its files in shared memory behind.
impl Drop for Around<'_> {
    fn drop(&mut self) {
        self.daemon.iter_mut().for_each(Process::terminate);
    }
}

/// What every measurement needs.
pub struct Setup<'a> {
    pub plan: &'a Plan,
    pub scratch: &'a Scratch,
    pub interrupted: &'a AtomicBool,
}

/// What one measurement found.
#[derive(Debug, Default)]
pub struct Found {
    /// Of both ends. CPU time is that of all processes, or of one half of a round trip: the sending and the receiving of one message.
    pub of: Measured,
    /// Of a receiver.
    pub wakes: Option<Wakes>,
    /// How often a gateway used up its budget.
    pub throttled: Option<u64>,
}

impl Setup<'_> {
    /// The job of one end of a case; `topic` is used nowhere else.
    pub fn job(&self, case: &Case, role: Role, topic: &str) -> Job {
        let (exchange, whole, topics, subscribers) = match case.task {
            Task::RoundTrips { whole } => (Exchange::RoundTrips, whole, 1, 1),
            Task::Requests => (Exchange::RoundTrips, false, 1, 1),
            Task::Paced { rate, topics, subscribers, .. } => {
                (Exchange::Paced { rate }, true, topics, subscribers)
            }
            Task::Stream { whole } => (Exchange::Stream { window: None }, whole, 1, 1),
            Task::Window => {
                let window = Some((WINDOW_BYTES / case.payload_bytes) as u64);
                (Exchange::Stream { window }, false, 1, 1)
            }
            // Messages until there is an answer: often enough to see when, not so often that they hold it up.
            Task::Start { topics, .. } => {
                let rounds_per_s = 1000.0 / topics.div_ceil(10) as f64;
                (Exchange::Paced { rate: rounds_per_s * topics as f64 }, true, topics, 1)
            }
        };
        let at_once = matches!(case.task, Task::Paced { at_once: true, .. });
        let [near, far] = self.plan.cores;
        let is_at_near = role == Role::Near && !case.mode.one_core;
        Job {
            role,
            exchange,
            payload_bytes: case.payload_bytes,
            budget: case.budget,
            core: self.plan.pin(if is_at_near { near } else { far }),
            realtime: self.plan.realtime,
            domain: match case.mode.program {
                Program::Gateways if role == Role::Far => FAR_DOMAIN,
                _ => DOMAIN,
            },
            topic: topic.to_owned(),
            endpoint: None,
            way: Way {
                mode: case.mode.mode.to_owned(),
                whole,
                topics,
                subscribers,
                processes: 0,
                at_once,
                times_sending: false,
                other_core: self.plan.pin(if is_at_near { far } else { near }),
            },
        }
    }

    /// Starts one end, which reads the memory of its `peers`, too.
    pub fn start(&self, case: &Case, job: &Job, peers: &str) -> Result<Process<'_, Line>> {
        let mut command = match case.mode.program {
            Program::Own | Program::Gateways => {
                let mut command = Command::new(std::env::current_exe()?);
                command.args(["--child", case.mode.system, &serde_json::to_string(job)?]);
                command
            }
            Program::Json(name) | Program::Daemon(name, _) => {
                let mut command = Command::new(std::path::absolute(self.plan.programs.find(name)?)?);
                command.arg(serde_json::to_string(job)?);
                // What r2r's loans need; it takes effect for types that can be lent alone.
                command.env("ROS_DISABLE_LOANED_MESSAGES", "0");
                command
            }
        };
        without_settings(&mut command);
        command.env("ROS_DOMAIN_ID", DOMAIN.to_string()).env(PEERS, peers);
        if case.mode.system == "r2r" {
            command.env("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp");
        }
        // Where no file of the user's sets anything.
        command.current_dir(self.scratch.directory());
        Process::start(&mut command, format!("{:?} end", job.role), self.interrupted)
    }

    /// What a system's processes find each other by, if they need it.
    fn meeting_place(&self, case: &Case) -> Result<Option<String>> {
        Ok(match (case.mode.system, case.mode.mode) {
            ("floor", mode @ ("futex" | "streaming" | "one-core" | "ring")) => {
                let path = PathBuf::from("/dev/shm").join(format!("{}{mode}", self.scratch.prefix()));
                let file = File::options().create(true).truncate(true).read(true).write(true).open(&path)?;
                let bytes = match mode {
                    "ring" => FutexRing::memory_bytes(case.payload_bytes),
                    _ => FutexPair::memory_bytes(case.payload_bytes),
                };
                file.set_len(bytes as u64)?;
                Some(path.display().to_string())
            }
            ("iceoryx2" | "taktora", _) => Some(self.scratch.directory().display().to_string()),
            _ => None,
        })
    }

    /// Starts what the ends of a case need beside them.
    pub fn around(&self, case: &Case) -> Result<Around<'_>> {
        let mut around = Around { gateways: None, daemon: None };
        match case.mode.program {
            Program::Gateways => {
                around.gateways = Some(
                    self.gateways(self.plan.cores.map(|core| self.plan.pin(core)), [self.plan.realtime; 2])?,
                );
            }
            Program::Daemon(_, name) => {
                // The ends wait for it.
                let mut command = Command::new(self.plan.programs.find(name)?);
                around.daemon = Some(Process::start(&mut command, name, self.interrupted)?);
            }
            Program::Own | Program::Json(_) => {}
        }
        Ok(around)
    }

    /// The gateways of both hosts.
    pub fn gateways(&self, cores: [Option<usize>; 2], realtime: [bool; 2]) -> Result<Gateways<'_>> {
        let host = |at: usize, domain| Host { domain, core: cores[at], realtime: realtime[at] };
        let hosts = [host(0, DOMAIN), host(1, FAR_DOMAIN)];
        Gateways::start(self.plan.programs.find(GATEWAY)?, hosts, NETWORK_DOMAIN, self.interrupted)
    }

    /// The far end, before it is ready. One that comes late is told where the others are.
    pub fn spawn_far(&self, case: &Case, topic: &str, others: Option<String>) -> Result<Process<'_, Line>> {
        let endpoint = self.meeting_place(case)?.or(others);
        self.start(case, &Job { endpoint, ..self.job(case, Role::Far, topic) }, "")
    }

    /// The far end, ready; and where the near one finds it.
    pub fn start_far(&self, case: &Case, topic: &str) -> Result<(Process<'_, Line>, Option<String>)> {
        let mut far = self.spawn_far(case, topic, None)?;
        let endpoint = far.expect(PATIENCE, Line::ready)?;
        Ok((far, endpoint))
    }

    /// The near end, which uses `endpoint`.
    pub fn start_near(
        &self,
        case: &Case,
        topic: &str,
        endpoint: Option<String>,
        fars: &[Process<'_, Line>],
    ) -> Result<Process<'_, Line>> {
        let peers: Vec<String> = fars.iter().map(|far| far.id().to_string()).collect();
        self.start(case, &Job { endpoint, ..self.job(case, Role::Near, topic) }, &peers.join(","))
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
        let mut near = self.start_near(case, topic, endpoint, far.as_slice())?;
        let measured = near.expect(PATIENCE + case.budget * 3, Line::measured)?;
        near.finish()?;
        if let Some(far) = &mut far {
            far.finish()?;
        }
        let mut found = Found::of(measured)?;
        if case.task == Task::Requests {
            found.of.times_ns.iter_mut().for_each(|time_ns| *time_ns *= 2);
        }
        Ok(found)
    }

    /// Measures a stream whose messages are confirmed.
    pub fn window(&self, case: &Case, topic: &str) -> Result<Found> {
        let (mut far, endpoint) = self.start_far(case, topic)?;
        let mut near = self.start_near(case, topic, endpoint, std::slice::from_ref(&far))?;
        let measured = far.expect(PATIENCE + case.budget * 3, Line::measured)?;
        near.finish()?;
        far.finish()?;
        Found::of(measured)
    }
}

impl Found {
    pub fn cpu_us_per_msg(&self) -> Option<f64> {
        let Measured { cpu_ns, messages, .. } = self.of;
        (cpu_ns > 0).then(|| rounded(cpu_ns as f64 / 1e3 / messages.max(1) as f64))
    }

    pub fn rss_mib(&self) -> Option<f64> {
        (self.of.memory.kib > 0).then(|| rounded(self.of.memory.kib as f64 / 1024.0))
    }

    /// So many messages, or ns of CPU time, in a second of the measurement.
    pub fn per_second(&self, number: u64) -> f64 {
        number as f64 / self.of.seconds.max(1e-9)
    }

    /// What one end measured of both.
    fn of(measured: Measured) -> Result<Self> {
        let messages = measured.times_ns.len() as u64;
        if messages == 0 {
            return Err("nothing arrived".into());
        }
        Ok(Found { of: Measured { messages, ..measured }, ..Found::default() })
    }
}
