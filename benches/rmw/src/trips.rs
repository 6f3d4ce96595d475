// SPDX-License-Identifier: MIT OR Apache-2.0
//! Half round trips between two processes, a core each.

use crate::system::{Message, PATIENCE, Starter, System, measured, ready};
use std::io::Write;
use std::path::Path;
use std::time::Duration;
use tautline_exchange::{APPLICATION_PRIORITY, Exchange, Job, Line, Measured, Result, Role};
use tautline_harness::rows::Tally;
use tautline_harness::{Distribution, Process};

/// Who calls the RMW.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Client {
    /// This program: `rmw_wait` and take.
    C,
    /// An executor of rclcpp with one thread.
    Rclcpp,
    /// One of rclpy.
    Rclpy,
}

impl Client {
    pub fn name(self) -> &'static str {
        match self {
            Client::C => "c",
            Client::Rclcpp => "rclcpp",
            Client::Rclpy => "rclpy",
        }
    }
}

/// What is sent, and by whom.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trip {
    pub client: Client,
    pub message: Message,
    pub bytes: usize,
    /// By a system file, of this program's own ends.
    pub is_governed: bool,
}

impl Trip {
    /// As in the rows.
    pub fn mode(self) -> String {
        format!("{}{}", self.message.name(), if self.is_governed { ", governed" } else { "" })
    }

    /// What it is called among the rows.
    pub fn experiment(self, held: bool) -> String {
        format!("{}/{}", self.client.name(), if held { "held-off" } else { "as-shipped" })
    }

    /// Another round of this length, with processes of its own.
    pub fn measure(
        self,
        starter: &Starter<'_>,
        system: &System,
        length: Duration,
        round: u32,
        tally: &mut Tally,
    ) -> Result<()> {
        let job = |role| {
            let job = starter.job(system, role, Exchange::RoundTrips, length);
            Job { payload_bytes: self.bytes, ..job }
        };
        let mut file = tempfile::NamedTempFile::new()?;
        file.write_all(system_file(&job(Role::Near), &job(Role::Far)).as_bytes())?;
        let governed = self.is_governed.then(|| file.path());
        let start = |role| self.start(starter, system, &job(role), governed);
        let mut far = start(Role::Far)?;
        ready(&mut far, PATIENCE)?;
        let mut near = start(Role::Near)?;
        let Measured { times_ns, lost, .. } = measured(&mut near, PATIENCE)?;
        near.finish()?;
        far.finish()?;
        let mut times = Distribution::new();
        times_ns.into_iter().for_each(|time_ns| times.record(time_ns));
        tally.add(round, &times);
        tally.lost += lost;
        Ok(())
    }

    fn start(
        self,
        starter: &Starter<'_>,
        system: &System,
        job: &Job,
        file: Option<&Path>,
    ) -> Result<Process<'static, Line>> {
        match self.client {
            Client::C => starter.start_governed(system, job, self.message.into(), file),
            client => starter.start_client(client, system, job),
        }
    }
}

/// A callback of each end, where the ends are without a file.
fn system_file(near: &Job, far: &Job) -> String {
    let end = |name: &str, job: &Job| {
        let ([_, from], core) = (job.topics(), job.core.unwrap_or(0));
        format!(
            "[nodes.{name}]\nclient = \"rclcpp\"\ncore = {core}\n[callbacks.{name}]\nnode = \"{name}\"\ntopic = \"{from}\"\nwcet = \"1us\"\n\
             priority = {APPLICATION_PRIORITY}\n[topics.\"{from}\"]\nperiod = \"1s\"\n"
        )
    };
    ["[hosts.here]\ncores = 2\n".to_owned(), end("near", near), end("far", far)].concat()
}
