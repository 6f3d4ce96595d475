// SPDX-License-Identifier: MIT OR Apache-2.0
//! The RMWs that are measured, and processes that use one of them.

use crate::trips::Client;
use clap::ValueEnum;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;
use tautline_exchange::{APPLICATION_PRIORITY, Exchange, Job, Line, Measured, Result, Role, Way};
use tautline_harness::{Process, without_settings};
use tempfile::NamedTempFile;

/// Nothing takes so long unless it is broken.
pub const PATIENCE: Duration = Duration::from_secs(60);
/// By which Fast DDS finds its profile: version 2 knows the first only, version 3 the second.
const PROFILE_VARIABLES: [&str; 2] = ["FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"];
/// Room in Fast DDS for the largest messages.
const PROFILE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/fast_dds.xml");
/// Nobody else measures or tests there.
const DOMAIN: u32 = 88;

/// An RMW.
pub struct System {
    /// As in `RMW_IMPLEMENTATION`.
    pub name: &'static str,
    pub library: PathBuf,
}

/// How a message of a round trip is handed over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Message {
    /// As a struct.
    Struct,
    /// Without its type support.
    Serialized,
    /// In memory of the RMW's.
    Loaned,
}

/// What a process of this program does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Task {
    Struct,
    Serialized,
    Loaned,
    /// Many topics at a rate.
    Flow,
    /// A node that waits for others.
    Node,
    /// Waits for messages that are there.
    Waits,
}

impl Message {
    /// As in the rows.
    pub fn name(self) -> &'static str {
        match self {
            Message::Struct => "struct",
            Message::Serialized => "serialized",
            Message::Loaned => "loaned",
        }
    }
}

impl From<Message> for Task {
    fn from(message: Message) -> Self {
        match message {
            Message::Struct => Task::Struct,
            Message::Serialized => Task::Serialized,
            Message::Loaned => Task::Loaned,
        }
    }
}

/// What is measured in rounds, of both RMWs in turns.
pub trait Case: Copy {
    /// By a system file, which no other RMW reads.
    fn is_governed(self) -> bool;

    /// What it is called among the rows; `is_held`: idle states are held off.
    fn experiment(self, is_held: bool) -> String;

    /// Of the messages.
    fn bytes(self) -> usize;

    fn name(self) -> String;

    /// As in the rows.
    fn mode(self) -> String {
        format!("{}{}", self.name(), if self.is_governed() { ", governed" } else { "" })
    }

    /// What `file` says is written for those that are governed.
    fn file(self, file: impl FnOnce() -> String) -> Result<Option<NamedTempFile>> {
        if !self.is_governed() {
            return Ok(None);
        }
        let mut written = NamedTempFile::new()?;
        written.write_all(file().as_bytes())?;
        Ok(Some(written))
    }

    /// Another round of this length, with processes of its own.
    fn measure(self, starter: &Starter<'_>, system: &System, length: Duration) -> Result<Measured>;
}

/// Where processes come from.
pub struct Starter<'a> {
    /// The Python that has rclpy, and a program of rclcpp.
    pub python: Option<&'a Path>,
    pub rclcpp: Option<&'a Path>,
    pub realtime: bool,
}

impl Starter<'_> {
    pub fn job(&self, system: &System, role: Role, exchange: Exchange, budget: Duration) -> Job {
        Job {
            role,
            exchange,
            payload_bytes: 0,
            budget,
            core: Some(if role == Role::Near { 0 } else { 1 }),
            realtime: self.realtime,
            domain: DOMAIN,
            topic: "/bench".to_owned(),
            endpoint: None,
            way: Way { mode: system.library.display().to_string(), ..Way::default() },
        }
    }

    /// A process of this program.
    pub fn start(&self, system: &System, job: &Job, task: Task) -> Result<Process<'static, Line>> {
        self.start_governed(system, job, task, None)
    }

    /// The same under a system file.
    pub fn start_governed(
        &self,
        system: &System,
        job: &Job,
        task: Task,
        file: Option<&NamedTempFile>,
    ) -> Result<Process<'static, Line>> {
        let mut command = Command::new(std::env::current_exe()?);
        without_settings(&mut command);
        command.args(["--tautline", "none", "--end", &serde_json::to_string(job)?]);
        command.args(["--task", task.to_possible_value().ok_or("no such task")?.get_name()]);
        if !matches!(task, Task::Flow | Task::Node) {
            command.envs(PROFILE_VARIABLES.map(|variable| (variable, PROFILE)));
        }
        self.govern(&mut command, file);
        // Fast DDS lends where its ends share memory, which its RMW allows by itself only so.
        if task == Task::Loaned {
            command.env("RMW_FASTRTPS_USE_QOS_FROM_XML", "1");
        }
        begin(command, system, job)
    }

    fn govern(&self, command: &mut Command, file: Option<&NamedTempFile>) {
        if let Some(file) = file {
            command.env("TAUT_SYSTEM", file.path());
            command.env("TAUT_REALTIME", if self.realtime { "required" } else { "off" });
        }
    }

    /// A process of a client library, as the programs beside this one have it, in a role with messages of so many bytes, or so many
    /// subscriptions.
    pub fn start_client(
        &self,
        client: Client,
        system: &System,
        job: &Job,
        (role, size): (&str, usize),
        file: Option<&NamedTempFile>,
    ) -> Result<Process<'static, Line>> {
        let program =
            self.program(client).ok_or_else(|| format!("no program of {} is named", client.name()))?;
        let mut command = Command::new(program);
        without_settings(&mut command);
        if client == Client::Rclpy {
            command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/client.py"));
        }
        self.govern(&mut command, file);
        let length = job.budget.as_millis();
        let (core, priority) = (job.core.unwrap_or(0), if job.realtime { APPLICATION_PRIORITY } else { 0 });
        command.arg(role).arg(&job.topic).args([format!("{size}"), format!("{length}")]);
        command.args([format!("{core}"), format!("{priority}")]);
        command.envs(PROFILE_VARIABLES.map(|variable| (variable, PROFILE)));
        command.env("RMW_IMPLEMENTATION", system.name).env("PYTHONDONTWRITEBYTECODE", "1");
        command.env("ROS_DOMAIN_ID", DOMAIN.to_string()).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
        // rcl of PyPI's packages is linked to one RMW, whose place another takes so.
        if system.library.is_absolute() {
            command.env("LD_PRELOAD", &system.library);
        }
        begin(command, system, job)
    }

    /// What a client library's end is run with; none of its own for C.
    pub fn program(&self, client: Client) -> Option<&Path> {
        match client {
            Client::C => None,
            Client::Rclpy => self.python,
            Client::Rclcpp => self.rclcpp,
        }
    }
}

fn begin(mut command: Command, system: &System, job: &Job) -> Result<Process<'static, Line>> {
    static NEVER: AtomicBool = AtomicBool::new(false);
    // What a user may have set is not what is measured.
    command.env_remove("RUST_LOG");
    let name = format!("{:?} end on {}", job.role, system.name).to_lowercase();
    Process::start(&mut command, name, &NEVER)
}

/// What a process measured.
pub fn measured(process: &mut Process<'_, Line>, patience: Duration) -> Result<Measured> {
    process.expect(patience, |line| match line {
        Line::Measured(measured) => Some(measured),
        _ => None,
    })
}

/// Waits until a process has said that it is ready.
pub fn ready(process: &mut Process<'_, Line>, patience: Duration) -> Result<()> {
    process.expect(patience, |line| matches!(line, Line::Ready(_)).then_some(()))
}
