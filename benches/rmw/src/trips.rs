// SPDX-License-Identifier: MIT OR Apache-2.0
//! Half round trips between two processes, a core each.

use crate::system::{Case, Message, PATIENCE, Starter, System, measured, ready};
use std::time::Duration;
use tautline_exchange::{APPLICATION_PRIORITY, Exchange, Job, Measured, Result, Role};

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

impl Case for Trip {
    fn is_governed(self) -> bool {
        self.is_governed
    }

    fn experiment(self, is_held: bool) -> String {
        format!("{}/{}", self.client.name(), if is_held { "held-off" } else { "as-shipped" })
    }

    fn bytes(self) -> usize {
        self.bytes
    }

    fn name(self) -> String {
        self.message.name().to_owned()
    }

    fn measure(self, starter: &Starter<'_>, system: &System, length: Duration) -> Result<Measured> {
        let job = |role| {
            let job = starter.job(system, role, Exchange::RoundTrips, length);
            Job { payload_bytes: self.bytes, ..job }
        };
        let file = self.file(|| system_file(&job(Role::Near), &job(Role::Far)))?;
        let start = |role| match self.client {
            Client::C => starter.start_governed(system, &job(role), self.message.into(), file.as_ref()),
            client => {
                let name = if role == Role::Near { "near" } else { "far" };
                starter.start_client(client, system, &job(role), (name, self.bytes), None)
            }
        };
        let mut far = start(Role::Far)?;
        ready(&mut far, PATIENCE)?;
        let mut near = start(Role::Near)?;
        let measured = measured(&mut near, PATIENCE)?;
        near.finish()?;
        far.finish()?;
        Ok(measured)
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
